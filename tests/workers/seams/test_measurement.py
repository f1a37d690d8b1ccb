"""The seams of a small model of two blocks, without and with a known step between them."""

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from panolog.partition.cells import Grid
from panolog.partition.faces import seams_of
from panolog.partition.plan import PartitionConfig, Plan, make_plan
from panolog.renderer.render import render_bytes
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import exposed, exposure_affine
from panolog.scene.model import Panorama, Scene
from panolog.workers.events import Evaluated, Event, SeamMeasured
from panolog.workers.seams.measurement import Seams
from panolog.workers.specs import Value
from panolog.workers.training.initialise import isotropic
from tests.workers.trainings import evaluation_of, progress_of

WIDTH, CAMERAS = 128, 16
PICTURES = ("truth", "merged", "below", "above")
SH0 = 0.28209479177387814  # the value of the spherical harmonic of degree 0


def ground() -> Gaussians:
    """A floor of discs, 1 below the cameras, of random colours."""
    random = np.random.default_rng(3)
    x, z = np.meshgrid(np.arange(-12, 12, 0.25), np.arange(-3, 3, 0.25))
    count = x.size
    means = np.stack([x.ravel(), np.ones(count), z.ravel()], axis=1)
    model = isotropic(means, np.full(count, 0.12), random.uniform(0.3, 0.6, (count, 3)), 0.993)
    model.scales[:, 1] = math.log(0.02)
    return model


def with_color(model: Gaussians, change: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Gaussians:
    """The model with its colours changed by (N, 1, 3), in [0, 1]."""
    return replace(model, sh0=model.sh0 + torch.tensor(change / SH0, dtype=torch.float32))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder, panoramas = tmp_path_factory.mktemp("scene"), []
    for k in range(CAMERAS):
        translation = -np.array([k - CAMERAS / 2 + 0.6, 0.0, 0.1 * (k % 3)])
        image, path = render_bytes(ground(), np.eye(3), translation, WIDTH, 0.01), folder / f"{k:02d}.png"
        cv2.imwrite(str(path), image.numpy()[..., ::-1])
        panoramas.append(Panorama(path.name, path, np.eye(3), translation, np.empty(0, np.int64)))
    rows = tuple(range(CAMERAS))
    points = np.zeros((1, 3))
    return Scene(
        folder, WIDTH, WIDTH // 2, tuple(panoramas), points, points.astype(np.uint8), rows, (0,), "ground"
    )


@pytest.fixture(scope="module")
def plan(scene: Scene) -> Plan:
    scores, names = np.ones((CAMERAS, 2)), [panorama.name for panorama in scene.panoramas]
    config, means, grid = PartitionConfig(rho_tri=2.0), ground().means.numpy(), Grid((2, 1, 1))
    return make_plan(scene.centers, means, scores, grid, config, rows=scene.train, names=names)


def models(step: float) -> tuple[Gaussians, Gaussians]:
    """A merged model that is brighter by `step` above the face, and a Stage I model with larger errors."""
    noise = np.random.default_rng(4).normal(0, 0.03, (len(ground()), 1, 3))
    above = (ground().means[:, 0].numpy() >= 0.1)[:, None, None]
    return with_color(ground(), noise / 2 + step * above), with_color(ground(), noise)


def events_of(scene: Scene, plan: Plan, step: float) -> list[Event]:
    merged, coarse = models(step)
    seams = Seams(seams_of(plan), Value(plan), Value(coarse))
    return list(evaluation_of(scene, merged, (0,), width=WIDTH, seams=seams).run())


def measured(events: Iterable[Event]) -> SeamMeasured:
    (event,) = (event for event in events if isinstance(event, SeamMeasured))
    return event


@pytest.fixture(scope="module")
def flat(scene: Scene, plan: Plan) -> list[Event]:
    """The events where there is no step."""
    return events_of(scene, plan, 0.0)


def known(value: float | None) -> float:
    assert value is not None
    return value


def test_without_a_step_a_face_is_as_any_other_place(plan: Plan, flat: list[Event]) -> None:
    """Progress counts the renders of seams too."""
    event, progress = measured(flat), progress_of(flat)
    assert (progress[0].iteration, progress[-1].iteration) == (1, progress[-1].iterations)
    assert progress[-1].iterations > 50
    kinds = [type(event) for event in flat if isinstance(event, Evaluated | SeamMeasured)]
    assert kinds == [Evaluated, SeamMeasured]
    assert event.seam.blocks == (0, 1)
    assert event.seam.at == pytest.approx(plan.aabb.center[0])
    assert event.seam.seam == pytest.approx(1.0, abs=0.1)
    assert event.seam.merged.error_ratio == pytest.approx(1.0, abs=0.2)
    assert event.seam.merged.error == pytest.approx(known(event.seam.coarse.error) / 2, rel=0.1)


def test_exposures_of_panoramas_are_no_errors(
    scene: Scene, plan: Plan, flat: list[Event], tmp_path: Path
) -> None:
    """Neither in what is measured nor in the pictures, where the models are as the photograph has it."""
    panoramas = []
    for row, panorama in enumerate(scene.panoramas):
        picture = cv2.imread(str(panorama.image))
        assert picture is not None
        exposure = np.array([np.full(3, 0.5 * (-1) ** row), np.zeros(3)])
        shown = exposed(torch.from_numpy(picture), exposure_affine(torch.from_numpy(exposure)))
        path = tmp_path / panorama.name
        cv2.imwrite(str(path), shown.numpy())
        panoramas.append(replace(panorama, image=path, exposure=exposure))
    without = measured(flat)
    event = measured(events_of(replace(scene, panoramas=tuple(panoramas)), plan, 0.0))
    for name in ("error", "step"):
        ours, theirs = (known(getattr(each.seam.merged, name)) for each in (event, without))
        assert ours == pytest.approx(theirs, rel=0.25)
    means = {
        name: np.asarray(cv2.imdecode(np.frombuffer(event.pictures[f"{name}.jpg"], np.uint8), 1)).mean()
        for name in PICTURES
    }
    assert [means[name] for name in PICTURES[1:]] == pytest.approx([means["truth"]] * 3, rel=0.03)


def test_a_step_of_a_known_size_is_found(scene: Scene, plan: Plan, flat: list[Event]) -> None:
    event, without = measured(events_of(scene, plan, 0.1)), measured(flat)
    assert event.seam.merged.step == pytest.approx(0.1, rel=0.2)
    assert event.seam.merged.step_floor == pytest.approx(without.seam.merged.step_floor, rel=0.1)
    assert known(event.seam.seam) > 5 * known(without.seam.seam)
    # All of the upper block has the error, so it is no larger at the face: only the step shows it.
    assert event.seam.merged.error_ratio == pytest.approx(1.0, abs=0.2)
    # Of the strip the upper half is 0.1 brighter in what the upper block shows.
    assert event.seam.difference.color == pytest.approx(0.05, abs=0.012)
    assert known(without.seam.difference.color) < 0.02
    assert event.seam.difference.depth == pytest.approx(0.0, abs=1e-3)
    assert event.seam.virtual > 0


def test_its_pictures_show_the_face(scene: Scene, plan: Plan) -> None:
    event = measured(events_of(scene, plan, 0.3))
    assert set(event.pictures) == {"truth.jpg", "merged.jpg", "below.jpg", "above.jpg", "face.png"}
    decoded = {
        name: np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), float)
        for name, data in event.pictures.items()
    }
    line = decoded["face.png"][..., 3] > 0
    assert 0.001 < line.mean() < 0.1
    apart = {
        name: np.abs(decoded[f"{name}.jpg"] - decoded["truth.jpg"]).mean(2) for name in ("below", "above")
    }
    changed = apart["above"] > 40  # brighter above the face, which the line is next to
    assert 0.05 < changed.mean() < 0.95
    rim = cv2.dilate(changed.astype(np.uint8), np.ones((61, 61))) - cv2.erode(
        changed.astype(np.uint8), np.ones((61, 61))
    )
    assert rim[line].mean() > 0.8
    assert (apart["below"] > 40).mean() < 0.01


def test_a_damaged_panorama_does_not_end_the_measurement(scene: Scene, plan: Plan, tmp_path: Path) -> None:
    broken = tmp_path / "07.png"
    broken.write_bytes(b"no picture")
    panoramas = list(scene.panoramas)
    panoramas[7] = replace(panoramas[7], image=broken)
    event = measured(events_of(replace(scene, panoramas=tuple(panoramas)), plan, 0.1))
    assert event.seam.merged.step == pytest.approx(0.1, rel=0.25)
