"""The dashboard: web pages of every run below a folder, live or not, and requests to their drivers.

From the outside in: `server` listens, `guard` decides which requests pass, `api` has the routes, `stream`
the server-sent events; `registry` keeps one `watch` for each run that `discovery` found. Nothing here imports
torch or Ray, and nothing but `actions` writes.
"""
