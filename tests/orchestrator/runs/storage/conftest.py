from collections.abc import Iterator

import pytest

from panolog.orchestrator.runs.storage.lease import Lease


@pytest.fixture(autouse=True)
def _leases_end(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Ends the leases that a test abandons as a killed driver does: their threads run on for some time."""
    made, begin = list[Lease](), Lease.__init__

    def begun(lease: Lease, *arguments: object) -> None:
        begin(lease, *arguments)  # type: ignore[arg-type]
        made.append(lease)

    monkeypatch.setattr(Lease, "__init__", begun)
    yield
    for lease in made:
        lease.end()
