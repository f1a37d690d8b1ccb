"""Runs side by side: read from run folders, compared in one place, shown on a terminal and on pages."""
