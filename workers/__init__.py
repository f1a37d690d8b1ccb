"""The GPU work of one task: coarse training, gradient scoring, block refinement, merge, evaluation.

A worker is a generator that yields typed events (`workers.events`); it never asks the driver anything.
"""
