"""seams.json: written as it is read, and refused where it is not of its kind."""

import json

import pytest

from panolog.scene.errors import InputError
from panolog.workers.seams.schema import Difference, Ratios, Seam, SeamsFile, by_blocks, parse_seams

NONE = dict.fromkeys(("error", "error_floor", "error_ratio", "step", "step_floor", "step_ratio"))
FLAT = Difference(color=0.1, psnr=20.0, depth=0.0, opacity=0.0)


def seam(above: int, value: float | None) -> Seam:
    ratios = Ratios(**NONE)
    return Seam(
        blocks=(0, above),
        axis="x",
        at=1.5,
        cameras=("a.jpg",),
        virtual=1,
        seam=value,
        merged=ratios,
        coarse=ratios,
        difference=FLAT,
    )


FACES = (seam(1, 1.5), seam(2, None), seam(3, 2.5))


def written(faces: tuple[Seam, ...]) -> bytes:
    return json.dumps(SeamsFile.of(faces).model_dump(mode="json"), allow_nan=False).encode()


def test_it_is_read_as_it_was_written_the_worst_first() -> None:
    assert parse_seams(written(FACES)) == (FACES[2], FACES[0], FACES[1])
    assert by_blocks(FACES) == {(0, 1): 1.5, (0, 3): 2.5}


def test_it_has_the_mean_and_the_worst() -> None:
    content = json.loads(written(FACES))
    assert (content["mean"], content["worst"]) == (2.0, 2.5)
    empty = json.loads(written((seam(1, None),)))
    assert (empty["mean"], empty["worst"]) == (None, None)


@pytest.mark.parametrize(
    "content", [b"", b"[]", b'{"faces": 1}', written(FACES).replace(b"2.5", b"-2.5"), b'{"faces": [{}]}']
)
def test_anything_else_is_refused(content: bytes) -> None:
    with pytest.raises(InputError, match=r"seams\.json"):
        parse_seams(content)
