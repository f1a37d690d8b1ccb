"""What looks at runs: views, the dashboard, and what follows a run to notify and to log. Reads only."""
