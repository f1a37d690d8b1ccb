"""What the metadata services say of a machine's end, against a server that answers as they do."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from panolog.orchestrator.engine.scheduling import metadata as module
from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.engine.scheduling.machine_end import Watch
from panolog.orchestrator.engine.scheduling.metadata import (
    VARIABLE,
    Amazon,
    Azure,
    Google,
    NoAnswerError,
    Provider,
    Service,
    detect,
)
from panolog.orchestrator.runs.records import Leaving
from tests.metadata_service import NAME, Metadata, metadata

REBALANCE = "/latest/meta-data/events/recommendations/rebalance"
PREEMPTED = "/computeMetadata/v1/instance/preempted"
MAINTENANCE = "/computeMetadata/v1/instance/maintenance-event"


@pytest.fixture
def served(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Metadata]:
    with metadata(request.param) as known:
        monkeypatch.setenv(VARIABLE, known.url)
        monkeypatch.setattr(module, "TIMEOUT_S", 60.0)
        yield known


def detected() -> Provider:
    provider = detect()
    assert provider is not None
    return provider


amazon, google, azure = (
    pytest.mark.parametrize("served", [name], indirect=True) for name in ("amazon", "google", "azure")
)


@pytest.mark.parametrize(
    ("served", "kind"),
    [("amazon", Amazon), ("google", Google), ("azure", Azure), ("", type(None))],
    indirect=["served"],
)
def test_the_provider_is_known_by_its_answer(served: Metadata, kind: type) -> None:
    assert isinstance(detect(), kind)
    assert served.requests


@pytest.mark.parametrize(
    ("files", "kind"),
    [
        ({"sys_vendor": "Amazon EC2\n"}, Amazon),
        ({"sys_vendor": "Xen", "bios_version": "4.11.amazon"}, Amazon),
        ({"sys_vendor": "Google", "product_name": "Google Compute Engine"}, Google),
        ({"chassis_asset_tag": "7783-7084-3265-9085-8269-3286-77"}, Azure),
        ({"sys_vendor": "Microsoft Corporation"}, type(None)),  # a laptop, or Hyper-V
        ({"sys_vendor": "LENOVO"}, type(None)),
        ({}, type(None)),
    ],
)
def test_the_firmware_names_the_provider_without_a_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files: dict[str, str], kind: type
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(module, "ADDRESS", "http://127.0.0.1:9")
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert isinstance(detect(tmp_path), kind)


@amazon
def test_amazon_announces_an_interruption_with_its_time_and_before_that_recommends_to_rebalance(
    served: Metadata,
) -> None:
    provider = detected()
    assert provider.notice() is None
    served.spot(120)
    notice = provider.notice()
    assert notice is not None
    assert notice.kind == Leaving.PREEMPTION
    assert notice.seconds is not None and 60 < notice.seconds <= 120
    served.expired = True
    again = provider.notice()
    assert again is not None and again.kind == Leaving.PREEMPTION
    assert served.tokens == 2
    assert Leaving.PREEMPTION not in provider.withdraws
    served.values.clear()
    served.values[REBALANCE] = '{"noticeTime": "2026-05-01T08:00:00Z"}'
    assert provider.notice() == LeaveNotice(Leaving.REBALANCE, None)
    assert Leaving.REBALANCE in provider.withdraws
    served.spot(-3)  # the clock of the machine is ahead
    assert provider.notice() == LeaveNotice(Leaving.PREEMPTION, 0.0)


@google
def test_google_takes_machines_away_and_stops_them_for_maintenance(served: Metadata) -> None:
    provider = detected()
    served.values[MAINTENANCE] = "MIGRATE_ON_HOST_MAINTENANCE"
    assert provider.notice() is None  # it is moved as it runs
    served.values[MAINTENANCE] = "TERMINATE_ON_HOST_MAINTENANCE"
    assert provider.notice() == LeaveNotice(Leaving.MAINTENANCE, None)
    served.values[PREEMPTED] = "TRUE"
    assert provider.notice() == LeaveNotice(Leaving.PREEMPTION, 30.0)


@azure
@pytest.mark.parametrize(
    ("event", "kind"),
    [
        ("Preempt", Leaving.PREEMPTION),
        ("Terminate", Leaving.TERMINATION),
        ("Reboot", Leaving.MAINTENANCE),
        ("Freeze", None),
    ],
)
def test_azure_schedules_events_for_this_machine_alone(
    served: Metadata, event: str, kind: Leaving | None
) -> None:
    provider = detected()
    served.event(event, resources=("worker-4",))
    assert provider.notice() is None
    soon = time.strftime("%a, %d %b %Y %H:%M:%S GMT", time.gmtime(time.time() + 100))
    served.event(event, resources=(NAME, "worker-4"), before=soon)
    notice = provider.notice()
    assert (notice.kind if notice else None) == kind
    if notice is not None:
        assert notice.seconds is not None and 40 < notice.seconds <= 100
    assert Leaving.PREEMPTION in provider.withdraws


WRONG = ['{"action"', "[1]", "null", "[" * 10_000, "x" * 2**17]


@amazon
@pytest.mark.parametrize("text", WRONG, ids=range(len(WRONG)))
def test_what_no_service_would_say_is_no_answer(served: Metadata, text: str) -> None:
    provider = detected()
    served.values["/latest/meta-data/spot/instance-action"] = text
    with pytest.raises(NoAnswerError):
        provider.notice()


@amazon
def test_an_answer_that_never_ends_is_cut(served: Metadata, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time is over once the headers of an answer are there."""

    def timer(seconds: float, cut: Callable[[], None]) -> threading.Timer:
        assert seconds == module.TIMEOUT_S
        return threading.Timer(0.0, lambda: cut() if served.looked.wait(60) else None)

    provider = detected()
    monkeypatch.setattr(module, "Timer", timer)
    served.slow = True
    served.looked.clear()
    with pytest.raises(NoAnswerError, match=r"it ends after \d{1,3} bytes|reset by peer"):
        provider.notice()
    served.slow = False


@pytest.mark.parametrize("url", ["ftp://host", "host:80", "http://"])
def test_an_address_that_is_none_is_named(monkeypatch: pytest.MonkeyPatch, url: str) -> None:
    monkeypatch.setenv(VARIABLE, url)
    with pytest.raises(ValueError, match=VARIABLE):
        detect()


@pytest.fixture
def watch(served: Metadata) -> Iterator[Watch]:
    with closing(Watch(look_s=0.01)) as watch:
        yield watch


def looks(served: Metadata, times: int) -> None:
    """Waits until the service has been requested so often."""
    last = len(served.requests) + times
    while len(served.requests) < last:
        served.looked.clear()
        assert served.looked.wait(60)


@azure
def test_a_watch_reports_a_notice_and_that_it_is_withdrawn(served: Metadata, watch: Watch) -> None:
    served.event("Preempt")
    assert watch.wait(None, 60) == LeaveNotice(Leaving.PREEMPTION, None)
    served.event("Preempt", resources=())
    assert watch.wait(Leaving.PREEMPTION, 60) is None


@amazon
def test_a_service_that_fails_withdraws_nothing(
    served: Metadata, watch: Watch, monkeypatch: pytest.MonkeyPatch
) -> None:
    served.values[REBALANCE] = "{}"
    assert watch.wait(None, 60) == LeaveNotice(Leaving.REBALANCE, None)
    served.status = 503
    looks(served, 6)
    assert watch.notice() == LeaveNotice(Leaving.REBALANCE, None)
    served.status = 0
    del served.values[REBALANCE]
    assert watch.wait(Leaving.REBALANCE, 60) is None
    served.spot(60)
    found = watch.wait(None, 60)
    assert found is not None and found.kind == Leaving.PREEMPTION
    served.values.clear()  # Amazon never withdraws that
    looks(served, 5)
    later = watch.notice()
    assert later is not None and later.seconds is not None and found.seconds is not None
    assert later.seconds < found.seconds
    monkeypatch.setattr("panolog.orchestrator.engine.scheduling.machine_end._SURVIVED_S", -1000.0)
    assert watch.wait(Leaving.PREEMPTION, 60) is None  # the machine was hibernated, and works again


def test_where_there_is_no_provider_the_thread_ends() -> None:
    before = threading.active_count()
    watch = Watch(lambda: None)
    for thread in threading.enumerate():
        if thread.name == "leave notices":
            thread.join(60)
    assert threading.active_count() <= before
    assert watch.notice() is None


def test_a_service_that_does_not_answer_is_quiet() -> None:
    with pytest.raises(NoAnswerError):
        Service("http://127.0.0.1:9").request("/", {})
