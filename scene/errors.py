"""The one exception tree. Every message is one line: what is wrong, where, and how to fix it.

Each error takes that line as its only argument, so it survives pickling across a process boundary.
"""


def in_one_line(error: BaseException, most: int | None = None) -> str:
    """What an error says, on one line; its class if it says nothing. Args: most, characters."""
    return " ".join(str(error).split())[:most] or type(error).__name__


class PanologError(Exception):
    """Root of all errors that PanoLOG raises on purpose."""


class InputError(PanologError):
    """What the user gave is wrong (a file, an option, a scene); the command line exits with 2."""


class SceneError(InputError):
    """A scene, or what a scene is made from, is missing, damaged or unfit for training."""


class ImageError(SceneError):
    """An image file can be read, but is no whole image: it is damaged, or has become another one."""


class PlyError(InputError):
    """A PLY file is missing, damaged or holds something else than expected."""


class FormatError(InputError):
    """A file of Gaussians that is no PLY is missing or damaged, or a model does not fit into one."""


class StoreError(InputError):
    """An object store, or what is to be in it, is missing, refuses access or has changed."""


class ConfigError(InputError):
    """A setting or an option has an unknown name or a value that is not allowed."""


class DeviceError(InputError):
    """The requested device, or what is needed to compute on it, is not there."""


class ClusterError(InputError):
    """A Ray cluster does not answer, refuses access or does not know the job."""


class RunFolderError(InputError):
    """A run folder is missing, damaged, of another version, or not in the state that the request needs."""


class RunLockedError(RunFolderError):
    """Another driver holds the run folder."""


class QueueError(InputError):
    """A queue of runs is damaged, of another version, or not in the state that the request needs."""


class RunError(PanologError):
    """The run itself failed although its input was right; the command line exits with 1."""


class ClusterLostError(RunError):
    """A Ray cluster has failed while a run was at work on it."""


class StoreLostError(RunError):
    """An object store has failed for too long."""
