from itertools import pairwise

from panolog.orchestrator.run.thinning import PREVIEWS, surplus

DAY = 86_400.0


def test_previews_are_the_first_the_latest_and_some_evenly_between() -> None:
    kept: list[int] = []
    for iteration in range(500, 100_001, 500):
        kept.append(iteration)
        if (gone := surplus(kept, iteration)) is not None:
            kept.remove(gone)
        assert len(kept) <= PREVIEWS
        assert (kept[0], kept[-1]) == (500, iteration)
    gaps = [after - before for before, after in pairwise(kept)]
    assert max(gaps) < 2 * 100_000 / PREVIEWS


def test_the_preview_of_a_repeated_iteration_is_kept() -> None:
    kept = list(range(100, 100 * PREVIEWS + 1, 100))
    assert surplus(sorted([*kept, 501]), 501) in (500, 600)
