"""Histories of runs made by hand."""

from panolog.orchestrator.run.records import Record, Stored


def history(*timed: tuple[float, Record]) -> list[Stored]:
    return [Stored(number, time, record) for number, (time, record) in enumerate(timed, 1)]
