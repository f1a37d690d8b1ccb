"""Videos as cameras write them: known frames in, the same frames out, in each codec and container."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.prepare.video import streams
from panolog.prepare.video.decode import open_video
from panolog.scene.errors import InputError
from tests.prepare.video import containers
from tests.prepare.video.containers import (
    BLOCK,
    H264,
    H265,
    H265_10,
    VP9,
    WIDTH,
    Encoding,
    Planes,
    add_spherical,
    add_spherical_xml,
    as_matroska,
    box,
    equirectangular,
    full,
    insert,
    known_frames,
    turn,
    write_clip,
)

pytestmark = pytest.mark.system

Floats = NDArray[np.float64]
Change = Callable[[Path], Path]
TIMES = [0, 40, 73, 140, 141, 300]  # milliseconds: a variable frame rate
_LUMA = {"bt709": (0.2126, 0.0722), "bt601": (0.299, 0.114), "bt2020": (0.2627, 0.0593)}  # of red, of blue


def expected(planes: Planes, colours: str = "bt709", range_: str = "limited", bits: int = 8) -> Floats:
    """(H / BLOCK, W / BLOCK, 3) BGR of a frame's blocks, by the formulas of the standards, not rounded."""
    luma, blue, red = (
        np.asarray(plane[side // 2 :: side, side // 2 :: side], np.float64) / 2 ** (bits - 8)
        for plane, side in zip(planes, (BLOCK, BLOCK // 2, BLOCK // 2), strict=True)
    )
    if range_ == "full":
        y, cb, cr = luma / 255, (blue - 128) / 255, (red - 128) / 255
    else:
        y, cb, cr = (luma - 16) / 219, (blue - 128) / 224, (red - 128) / 224
    kr, kb = _LUMA[colours]
    r, b = y + 2 * (1 - kr) * cr, y + 2 * (1 - kb) * cb
    g = (y - kr * r - kb * b) / (1 - kr - kb)
    return np.asarray(np.clip(255 * np.stack([b, g, r], axis=-1), 0, 255))


def blocks(picture: NDArray[np.uint8] | None) -> Floats:
    """(H / BLOCK, W / BLOCK, ...) the middles of the blocks."""
    assert picture is not None
    return np.asarray(picture[BLOCK // 2 :: BLOCK, BLOCK // 2 :: BLOCK], np.float64)


def same(picture: NDArray[np.uint8] | None, wanted: Floats) -> bool:
    """Whether the blocks of a picture have the wanted colours, rounded in any direction."""
    return bool(np.abs(blocks(picture) - wanted).max() < 0.6)


@pytest.mark.parametrize(
    ("container", "encoding"),
    [
        *[("mp4", it) for it in (H264, H265, H265_10)],
        *[("mov", H264), ("mkv", H264), ("mkv", H265_10), ("insv", H265), ("webm", VP9)],
    ],
    ids=lambda it: it if isinstance(it, str) else f"{it.codec}-{it.bits}",
)
def test_the_same_frames_at_the_same_times(container: str, encoding: Encoding, tmp_path: Path) -> None:
    frames = known_frames(len(TIMES), encoding.bits)
    path = write_clip(
        tmp_path / f"clip.{container}",
        frames,
        encoding,
        times=TIMES,
        container="mp4" if container == "insv" else None,
    )
    times = []
    with open_video(path) as video:
        assert (video.width, video.height) == (WIDTH, WIDTH // 2)
        for number in video.frames():
            times.append(video.time)
            wanted = expected(frames[number], bits=encoding.bits)
            assert same(video.picture(), wanted), number
            luma = (np.asarray(frames[number][0], np.float64) / 2 ** (encoding.bits - 8) - 16) * 255 / 219
            grey = video.grey()
            assert grey is not None and np.abs(grey - luma).max() < 0.6, number
        assert video.notes() == []
    assert times == pytest.approx([time / 1000 for time in TIMES], abs=1e-9)


@pytest.mark.parametrize(("container", "encoding"), [("mp4", H264), ("mkv", H265_10)], ids=["mp4", "mkv"])
def test_seeking_finds_the_frames_of_reading_in_order(
    container: str, encoding: Encoding, tmp_path: Path
) -> None:
    many = Encoding(encoding.codec, encoding.pixels, encoding.options | {"g": "8"})
    frames = known_frames(40, encoding.bits)
    path = write_clip(tmp_path / f"clip.{container}", frames, many)
    with open_video(path, "fast") as video:
        times = [video.time for _ in video.frames()]
        keys = video.keys
        assert video.is_plain
    assert len(times) == 40 and len(keys) > 2
    chosen = [0, 1, 7, 8, 19, 33, 39]
    with open_video(path, "fast") as video:
        for number, time in zip(chosen, video.frames_at([times[it] for it in chosen], keys), strict=True):
            assert time == times[number]
            assert same(video.picture(), expected(frames[number], bits=encoding.bits)), number
    with open_video(path, "fast") as video:
        assert list(video.frames_at([times[3], times[4] + 0.001, times[9]], keys)) == [times[3]]


def test_frames_that_none_refer_to_are_left_out_of_large_videos(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streams, "_LARGE", WIDTH)
    encoding = Encoding("libx264", "yuv420p", {"qp": "18", "x264-params": "b-adapt=0:bframes=2:b-pyramid=0"})
    path = write_clip(tmp_path / "clip.mp4", known_frames(40), encoding)
    with open_video(path) as video:
        every = [video.time for _ in video.frames()]
    with open_video(path, "fast") as video:
        some = [video.time for _ in video.frames() if video.grey(64) is not None]
        assert video.passed >= 38
        assert video.notes() == []
    assert len(every) == 40
    assert 12 < len(some) < 20 and set(some) < set(every)


@pytest.mark.parametrize("range_", ["limited", "full"])
@pytest.mark.parametrize("colours", ["bt709", "bt601", "bt2020"])
@pytest.mark.parametrize("encoding", [H264, H265_10], ids=["8", "10"])
def test_colours_are_those_of_the_tags(colours: str, range_: str, encoding: Encoding, tmp_path: Path) -> None:
    frames = known_frames(6, encoding.bits)
    path = write_clip(tmp_path / "clip.mp4", frames, encoding, colours=colours, range_=range_)
    others = [(it, kind) for it in _LUMA for kind in ("limited", "full") if (it, kind) != (colours, range_)]
    with open_video(path) as video:
        for number in video.frames():
            picture = video.picture()
            assert same(picture, expected(frames[number], colours, range_, encoding.bits))
            assert not any(same(picture, expected(frames[number], *it, encoding.bits)) for it in others)


@pytest.mark.parametrize(("size", "colours"), [((512, 256), "bt601"), ((1280, 640), "bt709")])
def test_colours_without_tags(size: tuple[int, int], colours: str, tmp_path: Path) -> None:
    frames = known_frames(1, size=size)
    path = write_clip(tmp_path / "clip.mp4", frames, colours=None, range_=None)
    with open_video(path) as video:
        assert list(video.frames()) == [0]
        assert same(video.picture(), expected(frames[0], colours))


@pytest.mark.parametrize(("transfer", "name"), [(16, "PQ"), (18, "HLG")])
def test_hdr_is_refused(transfer: int, name: str, tmp_path: Path) -> None:
    path = write_clip(tmp_path / "hdr.mp4", known_frames(6, 10), H265_10, colours="bt2020", transfer=transfer)
    with pytest.raises(InputError, match=rf"hdr\.mp4: its frames are HDR \({name}\); export it in SDR"):
        open_video(path).__enter__()


LAYOUTS: dict[str, tuple[tuple[int, int], Change, Callable[[Floats], Floats]]] = {
    "upside down": ((512, 256), lambda it: turn(it, (-1, 0, 0, -1)), lambda it: it[::-1, ::-1]),
    "mirrored": ((512, 256), lambda it: turn(it, (-1, 0, 0, 1)), lambda it: it[:, ::-1]),
    "flipped": ((512, 256), lambda it: turn(it, (1, 0, 0, -1)), lambda it: it[::-1]),
    "clockwise": ((256, 512), lambda it: turn(it, (0, 1, -1, 0)), lambda it: np.rot90(it, -1)),
    "anticlockwise": ((256, 512), lambda it: turn(it, (0, -1, 1, 0)), lambda it: np.rot90(it, 1)),
    "transposed": ((256, 512), lambda it: turn(it, (0, 1, 1, 0)), lambda it: it.swapaxes(0, 1)),
    "no panorama if it were upright": ((512, 256), lambda it: turn(it, (0, 1, -1, 0)), lambda it: it),
    "left eye on top": ((512, 512), lambda it: add_spherical(it, stereo=1), lambda it: it[:8]),
    "left eye on the left": ((1024, 256), lambda it: add_spherical(it, stereo=2), lambda it: it[:, :16]),
    "left eye on the right": ((1024, 256), lambda it: add_spherical(it, stereo=4), lambda it: it[:, 16:]),
    "one eye": ((512, 256), lambda it: add_spherical(it, stereo=0), lambda it: it),
    "eyes of a turned picture": (
        (512, 512),
        lambda it: turn(add_spherical(it, stereo=1), (-1, 0, 0, -1)),
        lambda it: it[::-1, ::-1][:8],
    ),
}


@pytest.mark.parametrize(("size", "change", "shown"), LAYOUTS.values(), ids=LAYOUTS)
def test_the_layout_of_the_pictures(
    size: tuple[int, int], change: Change, shown: Callable[[Floats], Floats], tmp_path: Path
) -> None:
    frames = known_frames(1, size=size)
    with open_video(change(write_clip(tmp_path / "clip.mov", frames))) as video:
        assert list(video.frames()) == [0]
        assert (video.width, video.height) == (512, 256)
        assert same(video.picture(), shown(expected(frames[0])))


@pytest.mark.parametrize(
    ("size", "pixel", "width"),
    [
        ((512, 254), None, 512),  # scaled by a program that has lost two rows
        ((384, 256), (4, 3), 512),  # narrower than shown
        ((512, 192), (3, 4), 512),  # wider than shown
        ((512, 256), (4, 3), 512),  # what is 2:1 is so, whatever its header says
    ],
)
def test_pictures_that_are_shown_as_2_1_are_stretched_to_it(
    size: tuple[int, int], pixel: tuple[int, int] | None, width: int, tmp_path: Path
) -> None:
    y, blue, red = known_frames(1, size=(size[0], -(-size[1] // BLOCK) * BLOCK))[0]
    planes = y[: size[1]], blue[: size[1] // 2], red[: size[1] // 2]
    path = write_clip(tmp_path / "clip.mp4", [planes])
    if pixel is not None:
        insert(path, "moov/trak/mdia/minf/stbl/stsd/*", box(b"pasp", struct.pack(">II", *pixel)))
    with open_video(path) as video:
        assert list(video.frames()) == [0]
        assert (video.width, video.height) == (width, width // 2)
        picture = video.picture()
        assert picture is not None and picture.shape == (width // 2, width, 3)
        rows, columns = size[1] // BLOCK, size[0] // BLOCK
        at = [((np.arange(it) + 0.5) * BLOCK).astype(int) for it in (rows, columns)]
        shown = picture[np.ix_(at[0] * (width // 2) // size[1], at[1] * width // size[0])]
        assert np.abs(shown - expected(planes)[:rows, :columns]).max() < 1.1


@pytest.mark.parametrize("version", [1, 2])
def test_the_pose_of_version_2_counts_not_where_a_viewer_looks(version: int, tmp_path: Path) -> None:
    path = write_clip(tmp_path / "clip.mp4", known_frames(1, size=(512, 512)))
    if version == 1:
        add_spherical_xml(path, StereoMode="top-bottom", InitialViewPitchDegrees=30)
    else:
        add_spherical(path, stereo=1, pose=(10.0, 20.0, -5.0))
    with open_video(path) as video:
        assert video.height == 256 and video.spherical is not None
        assert (video.spherical.pitch, video.spherical.roll) == ((0, 0) if version == 1 else (20, 5))


@pytest.mark.parametrize("version", [1, 2])
def test_a_cropped_panorama_is_placed(version: int, tmp_path: Path) -> None:
    frames = known_frames(1, size=(512, 256))
    path = write_clip(tmp_path / "clip.mp4", frames)
    if version == 1:
        pixels = {"CroppedAreaLeftPixels": 256, "CroppedAreaTopPixels": 64}
        pixels |= {"CroppedAreaImageWidthPixels": 512, "CroppedAreaImageHeightPixels": 256}
        add_spherical_xml(path, **pixels, FullPanoWidthPixels=1024, FullPanoHeightPixels=512)
    else:
        add_spherical(path, equirectangular(0.25, 0.125, 0.25, 0.375))
    with open_video(path) as video:
        assert list(video.frames()) == [0]
        picture = video.picture()
        assert picture is not None and picture.shape == (512, 1024, 3)
        assert same(picture[64:320, 256:768], expected(frames[0]))
        mask = video.layout.mask()
        assert (mask[64:320, 256:768] == 255).all() and mask.sum() == 255 * 256 * 512
        assert not picture[mask == 0].any()


def test_matroska_says_the_same(tmp_path: Path) -> None:
    frames = known_frames(1, size=(512, 512))
    path = write_clip(tmp_path / "clip.mp4", frames)
    add_spherical(path, equirectangular(0.25, 0.0, 0.25, 0.0), stereo=1)
    with open_video(as_matroska(path)) as video:
        assert list(video.frames()) == [0]
        picture = video.picture()
        assert picture is not None and picture.shape == (512, 1024, 3)
        assert not picture[:, :256].any() and not picture[:, 768:].any()
        wanted = expected(frames[0])[:8].repeat(2, axis=0)  # the left eye, twice as high as in the frame
        assert same(picture[:, 256:768], wanted)
    cube = add_spherical(write_clip(tmp_path / "cube.mp4", frames), full(b"cbmp", bytes(8)))
    with pytest.raises(InputError, match=r"cube\.mkv: its projection is cubemap"):
        open_video(as_matroska(cube)).__enter__()


@pytest.mark.parametrize(
    ("size", "change", "said"),
    [
        ((512, 512), lambda path: path, "512 x 512 pixels are not 2:1; stitch it"),
        ((768, 512), lambda path: add_spherical(path, full(b"cbmp", bytes(8))), "projection is cubemap"),
        ((512, 256), lambda path: add_spherical(path, full(b"mshp", bytes(8))), "projection is mesh"),
        ((512, 256), lambda path: add_spherical(path, full(b"\n\xffxy", bytes(8))), r"projection is \?\?xy"),
        ((512, 256), lambda path: add_spherical_xml(path, ProjectionType="cubemap"), "projection is cubemap"),
        ((512, 256), lambda path: add_spherical(path, stereo=3), r"two eyes is not known \(custom\)"),
        ((512, 256), lambda path: add_spherical(path, stereo=77), r"two eyes is not known \(custom\)"),
        ((512, 256), lambda path: add_spherical(path, equirectangular(0.5, 0, 0.4999, 0)), "too little"),
        ((512, 256), lambda path: add_spherical(path, equirectangular(0, 0.499, 0, 0.5)), "too little"),
    ],
)
def test_what_is_no_panorama_is_refused_with_what_to_do(
    size: tuple[int, int], change: Change, said: str, tmp_path: Path
) -> None:
    path = change(write_clip(tmp_path / "clip.mp4", known_frames(1, size=size)))
    with pytest.raises(
        InputError, match=rf"clip\.mp4: .*{said}.*export it as equirectangular 2:1 \(mono\)"
    ) as it:
        open_video(path).__enter__()
    assert "\n" not in str(it.value)


@pytest.mark.parametrize("suffix", ["insv", "360"])
def test_a_video_for_each_lens_is_refused(suffix: str, tmp_path: Path) -> None:
    path = write_clip(tmp_path / f"raw.{suffix}", known_frames(2, size=(256, 256)), container="mp4", lenses=2)
    with pytest.raises(InputError, match=rf"raw\.{suffix}: it has a video for each lens; stitch it"):
        open_video(path).__enter__()


def test_of_two_videos_of_panoramas_the_first_is_used(tmp_path: Path) -> None:
    frames = known_frames(2)
    with open_video(write_clip(tmp_path / "clip.mp4", frames, lenses=2)) as video:
        assert list(video.frames()) == [0, 1]
        assert same(video.picture(), expected(frames[1]))


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: containers.insert(path, "moov/trak", box(b"uuid", containers.SPHERICAL, b"<a" * 900)),
        lambda path: containers.insert(
            path, "moov/trak", box(b"uuid", containers.SPHERICAL, b'<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>')
        ),
        lambda path: add_spherical_xml(path, Spherical="false"),
        lambda path: add_spherical_xml(
            path, FullPanoWidthPixels="9" * 5000, CroppedAreaImageWidthPixels=-3, CroppedAreaLeftPixels="x"
        ),
    ],
)
def test_damaged_metadata_is_none(damage: Change, tmp_path: Path) -> None:
    frames = known_frames(1)
    with open_video(damage(write_clip(tmp_path / "clip.mp4", frames))) as video:
        assert list(video.frames()) == [0]
        assert same(video.picture(), expected(frames[0]))


def test_a_playlist_opens_no_other_file(tmp_path: Path) -> None:
    other = write_clip(tmp_path / "other.ts", known_frames(3), container="mpegts")
    path = tmp_path / "list.mp4"
    path.write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{other}\n#EXT-X-ENDLIST\n")
    with pytest.raises(InputError, match=r"list\.mp4: cannot be opened"):
        open_video(path).__enter__()
