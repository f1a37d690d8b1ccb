"""A model as a page for any web server, or as one file: what is sent to people who only have a browser."""
