"""What there is to run tasks on, and the part of it that one task gets. Plain values, no Ray."""

from dataclasses import dataclass

OWN = "local"  # `Node.id` of the driver's machine, until a pool of others has given it one


@dataclass(frozen=True)
class Gpu:
    """One GPU of a node."""

    name: str = "GPU"  # the product's; equal names are equally fast
    memory: int = 0  # bytes that were free when nothing of the run was on it; 0 = unknown
    uuid: str = ""  # by which CUDA finds it; "" = unknown


@dataclass(frozen=True)
class Node:
    """One machine, as it was when it was first seen."""

    id: str  # Ray's, or OWN
    host: str
    cpus: int
    memory: int  # bytes that were free, or held by workers of the run
    gpus: tuple[Gpu, ...] = ()
    instance: str = ""  # its type, as its provider calls it; "" if it does not say
    labels: tuple[tuple[str, str], ...] = ()  # Ray's, and its resources of the user's own
    closed: tuple[int, ...] = ()  # those of its GPUs that are in quarantine
    share: float = 1.0  # the part of it that no other program has: what a run pays

    def card(self, gpu: int) -> str:
        """The id of one of its GPUs: its UUID if that is known."""
        return _card(self.id, gpu, self.gpus[gpu].uuid)

    @property
    def differ(self) -> bool:
        """Whether it matters which of its GPUs a task gets: one is in quarantine, or larger, or other."""
        return bool(self.closed) or len({(gpu.name, round(gpu.memory / 2**30)) for gpu in self.gpus}) > 1


@dataclass(frozen=True)
class Placement:
    """Where a task runs and what it may use there."""

    node: str  # Node.id
    cpus: float  # cores, below one where GPUs are many and cores are few
    memory: int  # bytes it may count on: of the GPU, or of the node for a task on the CPU
    gpus: float = 0.0  # 1, or the part of one that it shares with others
    gpu: int | None = None  # which of Node.gpus
    uuid: str = ""  # of that GPU; "" = unknown
    pinned: bool = False  # it must be that one, also where Ray would pick another
    kind: str = "cpu"  # places of one kind are equally fast: "cpu", "NVIDIA L4" or "1/2 NVIDIA L4"

    @property
    def card(self) -> str:
        """`Node.card` of its GPU; "" for a task on the CPU."""
        return "" if self.gpu is None else _card(self.node, self.gpu, self.uuid)

    @property
    def threads(self) -> int:
        return max(1, int(self.cpus))


def _card(node: str, gpu: int, uuid: str) -> str:
    return uuid or f"{node}/{gpu}"
