import pytest

from panolog.orchestrator.engine.estimates.workers import Workers, WorkersRow


def table(*seconds: float, price: float | None = 1.0) -> Workers:
    rows = []
    for i, time in enumerate(seconds):
        hours = 2**i * time / 3600
        rows.append(WorkersRow(2**i, "auto", time, hours, None if price is None else hours * price))
    return Workers("kind", price, "USD" if price else "", tuple(rows))


@pytest.mark.parametrize(
    ("seconds", "knee"),
    [
        ((100, 50, 25, 12.5, 6.25), 16),  # as fast as could be
        ((100, 74, 60, 40, 20), 2),  # one doubling that hardly helps ends it
        ((100, 75, 56.25, 50, 49), 4),  # a quarter off is just enough
        ((100, 99, 98, 97, 96), 1),
        ((), None),
    ],
)
def test_the_knee_is_where_a_doubling_takes_less_than_a_quarter_off(
    seconds: tuple[float, ...], knee: int | None
) -> None:
    assert table(*seconds).knee == knee


def test_the_table_marks_the_knee_and_has_costs_only_with_a_price() -> None:
    lines = table(7200, 3600, 3500).lines()
    assert "1 USD per hour" in lines[0]
    assert ["save little time" in line for line in lines[2:]] == [False, True, False]
    assert table(7200, 7300).lines()[3].endswith("  no faster")
    assert "2.00" in lines[2]
    free = table(7200, 3600, price=None)
    assert "USD" not in "".join(free.lines())
    assert free.as_json()["rows"][0]["cost"] is None
    assert table().lines() == []
