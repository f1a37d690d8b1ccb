"""Object stores: scenes and runs below URLs such as s3://bucket/scene, opened through fsspec.

Credentials come from the providers' own chains (environment, profile, role of the machine) and from nowhere
else: they are in no URL, no file of a run and no command line. fsspec is imported when a store is opened.
"""
