"""The pages about runs, as the dashboard serves them and as files with a snapshot of what they show."""
