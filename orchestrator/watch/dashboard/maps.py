"""The map of a run's plan, kept as long as it stays as it is. Separate: threads share it."""

from collections import OrderedDict
from threading import Lock

from panolog.orchestrator.watch.dashboard.discovery import RunEntry
from panolog.orchestrator.watch.views.pages.encoding import encode
from panolog.orchestrator.watch.views.plan_page import map_of
from panolog.workers.tasks import COARSE

_CACHED = 4  # maps, of about a megabyte


class MapCache:
    """The maps that were requested last."""

    def __init__(self) -> None:
        self._maps: OrderedDict[str, tuple[tuple[int, ...], bytes]] = OrderedDict()
        self._lock = Lock()

    def map_of(self, entry: RunEntry) -> bytes:
        """The map from above, as JSON; pages draw the status of blocks themselves.

        Raises InputError if there is no plan yet or it cannot be read.
        """
        with self._lock:
            stamp = _stamp(entry)
            known = self._maps.pop(entry.id, None)
            if known is None or known[0] != stamp:
                known = (stamp, encode(map_of(entry.folder)))
            self._maps[entry.id] = known
            while len(self._maps) > _CACHED:
                self._maps.popitem(last=False)
            return known[1]


def _stamp(entry: RunEntry) -> tuple[int, ...]:
    """A value that changes when the plan, the points or the seams do."""
    folder = entry.folder
    outlined = (folder.outline_points, folder.outline_fixes)
    files = (folder.known_plan, folder.model(COARSE), *outlined, folder.seams)
    stats = [path.stat() for path in files if path.exists()]
    return tuple(number for stat in stats for number in (stat.st_mtime_ns, stat.st_size))
