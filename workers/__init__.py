"""The GPU work of one task: coarse training, gradient scoring, block refinement, merge, evaluation.

A task is a generator of typed events (`workers.events`), made from a spec (`workers.specs`).
"""
