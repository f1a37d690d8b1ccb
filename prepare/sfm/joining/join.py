"""`panolog scene sfm MORE --into SCENE`: from a scene and panoramas to a scene that has both."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm.consistency.agreement import Posed, motion_between
from panolog.prepare.sfm.consistency.contradictions import Contradiction
from panolog.prepare.sfm.consistency.evidence import read_evidence
from panolog.prepare.sfm.consistency.guided import Guide
from panolog.prepare.sfm.consistency.solve import Solver
from panolog.prepare.sfm.features import MEMORY
from panolog.prepare.sfm.joining.known import KnownScene, read_known, with_new
from panolog.prepare.sfm.links import links_of
from panolog.prepare.sfm.pairs import Pairing, Pairs, best_matches, choose_pairs, match_pairs
from panolog.prepare.sfm.pipeline import SfmSettings, check_place, new_scene, workspace_folder
from panolog.prepare.sfm.reconstruct import Reconstruction, featured, max_error
from panolog.prepare.sfm.report import Into, SfmReport, write_report
from panolog.prepare.sfm.sparse_model import from_colmap
from panolog.prepare.sfm.triangulate import neighbours, points_of
from panolog.prepare.sfm.workspace import Workspace, silence_colmap
from panolog.prepare.sources.find import find_sources
from panolog.prepare.sources.gather import gather
from panolog.prepare.world.georeference import MAX_SPREAD, Georeference
from panolog.prepare.world.gravity import find_up
from panolog.prepare.world.similarity import Similarity
from panolog.scene.errors import ConfigError, SceneError, in_one_line
from panolog.scene.files import some_of, stem_of, write_bytes
from panolog.scene.read import DEPTH_PARAMS, model_folder
from panolog.scene.write import StageProgress, require_new, write_scene


def join_scene(
    source: Sequence[Path],
    into: Path,
    output: Path,
    settings: SfmSettings,
    progress: StageProgress,
    memory: int = MEMORY,
) -> SfmReport:
    """Makes a scene of the scene `into` and of the panoramas of `source` in the new folder `output`.

    Poses, points, names and layers of `into` are in it as they are; the folder `into` is only read. An
    interrupted job is resumed by the next call.
    Args: memory, bytes that may be used.

    Raises SceneError if the scene or a source is wrong, or half of the panoramas or fewer can be joined, and
    no part is accepted: there is no `output` then; ConfigError if settings would move the scene. RunError if
    a process is killed, OSError if a file fails.
    """
    require_new(output)
    _check_settings(settings)
    check_place(output, (*source, into))
    known, folder = read_known(into), workspace_folder(output.resolve())
    taken = {known.scene.root.name, *(Path(it.name).parts[0] for it in known.images)}
    sources = find_sources(source, taken)
    gathered = gather(sources, folder, settings, progress, known.panoramas)
    found = _join(known, gathered.panoramas, folder, settings, progress, memory)
    notes, scene = gathered.notes, Into(into, len(known.images))
    report = SfmReport(found, _world(known), notes, gathered.left_out, 1, sources.all, scene)
    made = any(panorama.path.is_relative_to(folder) for panorama in found.panoramas)
    write_scene(
        output,
        new_scene(found, known.offset, known.scene.colors, _split(known, found), known.images),
        link=settings.link and not made,  # the workspace is removed, with the panoramas in it
        progress=lambda done, total: progress("scene", done, total),
        complete=lambda new: _complete(new, known, report),
    )
    shutil.rmtree(folder, ignore_errors=True)
    return report


def _check_settings(settings: SfmSettings) -> None:
    """Raises ConfigError if one of them says where the world is, or needs a world of its own."""
    wrong = {
        "--distance": settings.distance is not None,
        "--trajectory": settings.trajectory is not None,
        "--mapper global": settings.mapper == "global",
    }
    for option in (option for option, given in wrong.items() if given):
        raise ConfigError(f"{option}: with --into the poses and the world of the scene stay; leave it out")


def _join(
    known: KnownScene,
    panoramas: Sequence[PanoramaFile],
    folder: Path,
    settings: SfmSettings,
    progress: StageProgress,
    memory: int,
) -> Reconstruction:
    """The scene with the panoramas that agree with it. Results are kept in `folder`, for the next call.

    Args: panoramas, those of the scene first. Raises SceneError if most cannot be joined.
    """
    work, count = Workspace(folder, tuple(panoramas)), len(known.images)
    with silence_colmap():
        size, features = featured(work, progress, memory)
        pairs = _pairs(work, known, settings.pairing, progress)
        match_pairs(work, pairs, max_error(size[0]), progress)
        model = _points(work, known, size)
        against, cuts, unconfirmed = list[Contradiction](), list[Contradiction](), set[int]()
        while model.num_reg_images() < len(panoramas):
            solver = Solver(work, size, "incremental", max_error(size[0]), progress, known=model)
            found = solver.joined()
            cuts += solver.cuts
            unconfirmed |= solver.unconfirmed
            if found is None:
                break
            model, against = found.model, [*against, *found.contradictions]
        sparse = from_colmap(model, work.numbers, size)
        shared = best_matches(work)
    missing = {row: shared[row] for row in range(len(panoramas)) if row not in sparse.rows}
    against += [it for it in cuts if not missing.keys().isdisjoint(it.between)]
    joined = len(sparse.rows) - count
    if not joined or not (settings.partial or joined > len(missing)):
        raise SceneError(_refusal(known, panoramas, missing, against))
    whole = with_new(known, sparse, size, max_error(size[0]))
    return Reconstruction(
        panoramas=tuple(panoramas),
        size=size,
        model=whole,
        links=links_of(whole, size[0]),
        contradictions=against,
        missing=missing,
        unconfirmed=frozenset(unconfirmed & missing.keys()),
        others=[],
        features=features,
        pairs=len(pairs),
    )


def _points(work: Workspace, known: KnownScene, size: tuple[int, int]) -> pycolmap.Reconstruction:
    """The poses of the scene, and points for the features of its panoramas.

    These are matched along the motions that the poses say: where windows repeat, what has matched freely may
    be one window off, and where they repeat along the way, that gives points at wrong distances.

    Raises SceneError: there are no points.
    """
    evidence = read_evidence(work, size)
    guide = Guide(work, evidence.rays, max_error(size[0]) * 2 * np.pi / size[0])
    poses = Posed({row: (it.rotation, it.translation) for row, it in enumerate(known.images)}, {})
    edges = [pair.between for pair in evidence.among(poses.poses).pairs]
    motions = {edge: motion_between(poses, edge) for edge in edges}
    kept = {edge: guide.along(edge, motion) for edge, motion in motions.items() if motion is not None}
    try:
        return points_of(work.with_pairs(kept, "known.db"), known.images, size)
    except (RuntimeError, ValueError) as error:
        raise SceneError(
            f"{known.scene.root}: its panoramas near the new ones show no points ({in_one_line(error, 120)})"
        ) from error


def _pairs(work: Workspace, known: KnownScene, pairing: Pairing, progress: StageProgress) -> Pairs:
    """Pairs with a panorama that is new, and of the scene's ones in these each with its neighbours."""
    ids = work.ids()
    of_scene = ids[: len(known.images)]
    pairs = [pair for pair in choose_pairs(work, pairing, progress) if not set(pair) <= set(of_scene)]
    near = {number for pair in pairs for number in pair}
    for a, b in neighbours(known.images):
        if near & {ids[a], ids[b]}:
            pairs.append((min(ids[a], ids[b]), max(ids[a], ids[b])))
    return sorted(pairs)


def _refusal(
    known: KnownScene,
    panoramas: Sequence[PanoramaFile],
    missing: dict[int, tuple[int, int]],
    against: Sequence[Contradiction],
) -> str:
    """One line: which panoramas could not be joined, and what to do."""
    names = [panorama.name for panorama in panoramas]
    count, new = len(known.images), len(panoramas) - len(known.images)
    lost = some_of([names[row] for row in missing], "panorama")
    row, (other, shared) = max(missing.items(), key=lambda it: it[1][1])
    why = f"{names[row]} and {names[other]} share most, {shared} features"
    if against:
        one, two = (names[row] for row in against[0].between)
        why = f"{one} and {two} contradict each other, as where windows repeat"
    return (
        f"{known.scene.root}: of {new} panoramas {new - len(missing)} agree with its {count}, without {lost} "
        f"({why}); take more between them and the scene, or accept these with --partial"
    )


def _world(known: KnownScene) -> Georeference:
    """The world of the scene, as far as its files say what it is."""
    up, _ = find_up(np.stack([it.rotation for it in known.images]), [None] * len(known.images))
    frame: Literal["arbitrary", "upright", "enu"] = "arbitrary"
    if up.spread <= MAX_SPREAD and up.direction[2] >= np.cos(np.deg2rad(MAX_SPREAD)):
        frame = "upright"
    metric = known.offset is not None and (known.offset.metres, known.offset.frame) != (None, None)
    if known.offset is not None and known.offset.frame is not None:
        frame = "enu"
    return Georeference(Similarity(1.0, np.eye(3), np.zeros(3)), frame, metric, up, None, ())


def _split(known: KnownScene, found: Reconstruction) -> dict[str, list[str]] | None:
    """The split of the scene, if it has one, whose training panoramas the new ones join."""
    if known.split is None:
        return None
    new = [stem_of(found.panoramas[row].name) for row in found.model.rows[len(known.images) :]]
    return {**known.split, "train.txt": [*known.split["train.txt"], *new]}


def _complete(folder: Path, known: KnownScene, report: SfmReport) -> None:
    """Writes what else belongs into the new scene: the affines of its depth maps, and the report."""
    affines = model_folder(known.scene.root) / DEPTH_PARAMS
    if affines.is_file():
        write_bytes(folder / "sparse" / "0" / DEPTH_PARAMS, affines.read_bytes())
    write_report(folder, report)
