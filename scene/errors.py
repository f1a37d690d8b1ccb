"""The one exception tree. Every message is one line that says what is wrong, where, and how to mend it.

Each error takes that line as its only argument, so it survives pickling across a process boundary.
"""


class PanologError(Exception):
    """Root of all errors that PanoLOG raises on purpose."""


class InputError(PanologError):
    """What the user gave is wrong (a file, an option, a scene); the command line exits with 2."""


class RunError(PanologError):
    """The run itself failed although its input was right; the command line exits with 1."""
