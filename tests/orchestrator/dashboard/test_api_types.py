"""What the pages know of the API."""

from tests.orchestrator.dashboard import api_types


def test_the_declaration_is_up_to_date() -> None:
    assert api_types.FILE.read_text() == api_types.declaration(), "run `make types`"
