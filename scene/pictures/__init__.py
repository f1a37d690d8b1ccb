"""Pictures: which are no panoramas, and what their colours mean."""
