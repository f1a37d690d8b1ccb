"""A run shown: tables, figures, report, 3D page. Read-only."""
