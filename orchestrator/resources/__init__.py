"""What tasks need and what machines have: estimates, placement, preflight."""
