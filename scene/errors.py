"""The one exception tree. Every message is one line: what is wrong, where, and how to fix it.

Each error takes that line as its only argument, so it survives pickling across a process boundary.

Modules import the packages of an extra as any other; where one is missing, `explained` says what to install.
"""

import re
from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

PACKAGES = {  # a module: its name for people, and the extra of pyproject.toml
    "av": ("PyAV", "prepare"),
    "pycolmap": ("pycolmap", "prepare"),
    "ray": ("Ray", "cluster"),
    "requests": ("requests", "cluster"),
    "fastapi": ("FastAPI", "dashboard"),
    "matplotlib": ("matplotlib", "prepare"),
    "starlette": ("Starlette", "dashboard"),
    "uvicorn": ("uvicorn", "dashboard"),
    "OpenEXR": ("OpenEXR", "export"),
    "pyproj": ("pyproj", "export"),
    "pi_heif": ("pi-heif", "formats"),
}

_SHORTAGE = re.compile(  # what says so in words only: torch of the CPU, the driver, CUDA's libraries, OpenCV
    "out[ _]of[ _]memory|alloc(ation)?_failed|defaultcpuallocator|insufficient memory|cannot allocate memory"
    "|bad_alloc|memoryallocation",
    re.IGNORECASE,
)


def out_of_memory(error: BaseException) -> bool:
    """Whether an error, of whatever class, says that memory of the host or of a GPU was not enough."""
    return isinstance(error, MemoryError) or _SHORTAGE.search(str(error)) is not None


def in_one_line(error: BaseException, most: int | None = None) -> str:
    """What an error says, on one line; its class if it says nothing. Args: most, characters."""
    return " ".join(str(error).split())[:most] or type(error).__name__


def first_line(text: str) -> str:
    """The first line of a text; "" where it has none."""
    return (text.strip().splitlines() or [""])[0]


def last_line(text: str) -> str:
    """The last line of a text that is not blank; "" where it has none."""
    return text.strip().rpartition("\n")[2].strip()


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


class MissingPackageError(InputError):
    """A package is missing that only some of PanoLOG needs."""

    @staticmethod
    def of(module: str) -> "MissingPackageError":
        """Says what to install for a module of `PACKAGES`."""
        return MissingPackageError(f"this needs {PACKAGES[module][0]}: {command_for(module)}")


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


# What a value must be, by pydantic's type of the error and by the values that it compares with.
_MUST_BE = {
    **dict.fromkeys(("model_type", "model_attributes_type", "dict_type"), "keys with values are needed"),
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "a whole number is needed"),
    **dict.fromkeys(("float_type", "float_parsing"), "a number is needed"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false is needed"),
    **dict.fromkeys(("tuple_type", "list_type"), "a list is needed"),
    "string_type": "text is needed",
    "finite_number": "a finite number is needed",
    "greater_than_equal": "it must be at least {ge}",
    "greater_than": "it must be above {gt}",
    "less_than_equal": "it must be at most {le}",
    "less_than": "it must be below {lt}",
    "literal_error": "it must be {expected}",
    "missing": "it is missing",
}


def wrong_value(error: Mapping[str, Any]) -> str:
    """What is wrong with a value, in a few words. Args: error, of `ValidationError.errors` of pydantic."""
    words = _MUST_BE.get(error["type"])
    if words is None:
        return str(error["msg"]).removeprefix("Value error, ")  # of a check of our own
    return words.format_map(error.get("ctx", {}))


def command_for(module: str) -> str:
    """What installs a module of `PACKAGES`."""
    return f"pip install 'panolog[{PACKAGES[module][1]}]'"


def installed(module: str) -> bool:
    """Whether a package is there; imports nothing."""
    return find_spec(module) is not None


def require(module: str) -> None:
    """Raises MissingPackageError if a module of `PACKAGES` is not installed; imports nothing."""
    if not installed(module):
        raise MissingPackageError.of(module)


def explained(error: ModuleNotFoundError) -> MissingPackageError | None:
    """What a failed import says to a user; None if its package is of no extra, so that it is a fault."""
    module = (error.name or "").partition(".")[0]
    return MissingPackageError.of(module) if module in PACKAGES else None
