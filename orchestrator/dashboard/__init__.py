"""The dashboard: one page for each run below a folder, live or not, and what can be asked of its driver.

`places` finds runs and opens their files, `watch` follows one run, `board` all that somebody looks at, `api`
answers, `stream` goes on answering, `guard` decides who may ask, `server` listens. Nothing here imports torch
or Ray.
"""
