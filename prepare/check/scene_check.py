"""`panolog scene check`: the measurements, and one line for each problem."""

from dataclasses import dataclass

import numpy as np

from panolog.prepare.check.blank import find_blank
from panolog.prepare.check.conventions import FIT, GAIN, best_convention, residuals
from panolog.prepare.check.evidence import Array, Evidence, gather_evidence
from panolog.prepare.check.exposure import describe, measure_exposures
from panolog.prepare.check.layers import look_at_layers
from panolog.prepare.check.misplaced import find_misplaced, misplaced_lines
from panolog.prepare.check.photometry import PixelShift, common_shift, fits_of_poses, patch_agreement
from panolog.prepare.networks.nadir import black_nadir
from panolog.scene.files import some_of
from panolog.scene.model import Scene

_RESIDUAL = 3.0  # pixels: a reconstruction with a larger median is not one
_SHIFT = 0.3, 1.5  # pixels: a shift in between is a pixel convention, a larger one is something else
_SURE = 4.0  # sigmas
_CLEAR = 0.85  # correlation of colours above which points without tracks are rarely hidden
_MISFIT = 0.1  # by how much another pose must fit a picture better than its own
_OWNER = 0.5  # and how well at least
_UPRIGHT = 0.8  # length of the mean of the cameras' up vectors


@dataclass(frozen=True)
class SceneCheck:
    """What was measured, and the problems: the keys of `panolog scene check --json`."""

    panoramas: int
    observations: int
    reprojection_px: float | None  # median; None without tracks
    track_shift_px: tuple[float, float] | None  # median of observed minus reprojected
    color_correlation: float | None  # of points and pixels, median over panoramas; None without colours
    patch_correlation: float  # of patches in two views, median
    picture_shift_px: tuple[float, float] | None  # of the pictures against the points; None if not known
    picture_shift_sigma_px: float | None
    up: tuple[float, float, float]  # mean up vector of the cameras, in the world
    exposure_spread_stops: float | None  # rms of log gains over panoramas and channels; None if not known
    exposure_stops: dict[str, float]  # of each panorama over the mean, by name
    exposure: str  # the same as text
    misplaced: dict[str, str]  # panoramas that are not where their poses say, and why
    black_nadir_degrees: float | None  # from straight down, within which the panoramas are black and unmasked
    blank: tuple[str, ...]  # panoramas that are black, or of one other colour
    layers: tuple[str, ...]  # what masks leave out, and files of layers that match nothing
    problems: tuple[str, ...]

    @property
    def verdict(self) -> str:
        """Whether it can be trained on, as text."""
        if not self.problems:
            return "verdict: poses, points and panoramas fit together"
        if self.misplaced:
            return (
                f"verdict: {len(self.misplaced)} of {self.panoramas} panoramas fit no more than by chance; "
                "correct their poses or leave them out, or training yields fog around them"
            )
        count = f"{len(self.problems)} problems" if len(self.problems) > 1 else "a problem"
        return f"verdict: {count}; fix that first, or training yields fog"

    def lines(self) -> list[str]:
        """The measurements as text."""
        found = [f"{self.panoramas} panoramas, {self.observations:,} observations of points"]
        if self.reprojection_px is not None:
            found.append(f"reprojection: median {self.reprojection_px:.2f} px")
        if self.color_correlation is None:
            found.append("the points have no colours, or are few: only tracks and patches are checked")
        else:
            found.append(f"colours of points and pixels: correlation {self.color_correlation:.2f}")
        found.append(f"patches of the same points in two views: correlation {self.patch_correlation:.2f}")
        if self.picture_shift_px is not None:
            u, v = self.picture_shift_px
            found.append(
                f"pictures against points: {u:+.2f}, {v:+.2f} px (± {self.picture_shift_sigma_px:.2f})"
            )
        found += [self.exposure, *self.layers]
        axis = int(np.argmax(np.abs(self.up)))
        sign = "+" if self.up[axis] > 0 else "-"
        found.append(f"up is about {sign}{'xyz'[axis]} ({', '.join(f'{x:.2f}' for x in self.up)})")
        if np.linalg.norm(self.up) < _UPRIGHT:
            found.append(
                "the cameras do not agree where up is: they were tilted at random, or their poses are wrong"
            )
        if self.black_nadir_degrees is not None:
            found.append(
                f"all panoramas without a mask are black within {self.black_nadir_degrees:g} degrees of "
                "straight down: `panolog scene mask SCENE --nadir auto` masks that"
            )
        return found


def check_scene(scene: Scene) -> SceneCheck:
    """Measures how poses, points and panoramas of a scene fit.

    Raises SceneError: a panorama cannot be decoded, or the model is damaged.
    """
    evidence = gather_evidence(scene)
    apart = residuals(evidence)
    patches = patch_agreement(evidence)
    shift = None if evidence.colorless else common_shift(evidence)
    up = -np.mean([panorama.rotation[1] for panorama in scene.panoramas], axis=0)
    reprojection = float(np.median(np.linalg.norm(apart, axis=1))) if len(apart) else None
    problems = _conventions(evidence, reprojection)
    colors, exposures = None, measure_exposures(scene, range(len(scene.panoramas)))
    layers, blank = look_at_layers(scene), find_blank(scene)
    names = [panorama.name for panorama in scene.panoramas]
    if not evidence.colorless:
        fits = fits_of_poses(evidence)
        colors = float(np.median(fits.diagonal()))
        problems = problems or _names(evidence, fits)
    misplaced = {} if problems else find_misplaced(scene)
    problems = problems or misplaced_lines(misplaced)
    if not problems:
        problems = (
            _tracks(apart, reprojection)
            + _pixels(shift, colors, len(apart) > 0)
            + _nothing_fits(colors, patches)
        )
    return SceneCheck(
        panoramas=len(scene.panoramas),
        observations=sum(len(panorama.observed) for panorama in scene.panoramas),
        reprojection_px=reprojection,
        track_shift_px=tuple(np.median(apart, axis=0).tolist()) if len(apart) else None,
        color_correlation=colors,
        patch_correlation=patches,
        picture_shift_px=(shift.u, shift.v) if shift else None,
        picture_shift_sigma_px=shift.sigma if shift else None,
        up=(float(up[0]), float(up[1]), float(up[2])),
        exposure_spread_stops=exposures.spread if exposures else None,
        exposure_stops=dict(zip(names, exposures.stops.tolist(), strict=True)) if exposures else {},
        exposure=describe(names, exposures) if exposures else "exposure: too few common points to compare",
        misplaced=misplaced,
        black_nadir_degrees=_black_nadir(evidence),
        layers=layers.lines,
        blank=tuple(blank),
        problems=(*_blanks(blank), *(problems or layers.inverted), *layers.problems),
    )


def _blanks(names: list[str]) -> list[str]:
    if not names:
        return []
    return [
        f"pictures: {some_of(names, 'panorama')}: black, or of one other colour; leave them out, or training"
        " learns that colour"
    ]


def _black_nadir(evidence: Evidence) -> float | None:
    """The angle of `black_nadir` of the panoramas that have no mask and are not transparent."""
    masked = (evidence.scene.panoramas[row].masked for row in evidence.views)
    return black_nadir(it for it, known in zip(evidence.pictures, masked, strict=True) if not known)


def _conventions(evidence: Evidence, reprojection: float | None) -> list[str]:
    """Whether another convention fits much better: by the pictures, else by the tracks."""
    if not evidence.colorless:
        best, fit, ours = best_convention(evidence, by_tracks=False)
        if fit > max(FIT, ours + GAIN):
            return [f"axes: {best.description}; then the colours correlate by {fit:.2f}, now by {ours:.2f}"]
    if reprojection is None or reprojection < _RESIDUAL:
        return []
    best, fit, ours = best_convention(evidence, by_tracks=True)
    if fit > max(FIT, ours + GAIN):
        return [f"axes: {best.description}; then {fit:.0%} of the observations fit, now {ours:.0%}"]
    return []


def _names(evidence: Evidence, fits: Array) -> list[str]:
    """Pictures that fit the pose of another better than their own."""
    best = fits.argmax(axis=1)
    own = fits.diagonal()
    wrong = [i for i, j in enumerate(best) if j != i and fits[i, j] > max(_OWNER, own[i] + _MISFIT)]
    if len(wrong) < 2:
        return []
    name = [evidence.scene.panoramas[row].name for row in evidence.views]
    i = max(wrong, key=lambda index: float(fits[index, best[index]] - own[index]))
    return [
        f"names: {len(wrong)} of {len(own)} pictures fit another's pose better; {name[i]} fits that of "
        f"{name[best[i]]} (correlation {fits[i, best[i]]:.2f}, its own {own[i]:.2f}): they are mixed up"
    ]


def _tracks(apart: Array, reprojection: float | None) -> list[str]:
    if reprojection is None:
        return []
    if reprojection > _RESIDUAL:
        return [
            f"tracks: the points miss their observations by {reprojection:.1f} px (median); poses are wrong"
        ]
    u, v = np.median(apart, axis=0)
    sigma = 1.25 * np.median(np.abs(apart - (u, v)), axis=0) * 1.48 / np.sqrt(len(apart))
    return _half_pixel("tracks: the observations", float(u), float(v), float(sigma.max()))


def _pixels(shift: PixelShift | None, colors: float | None, tracked: bool) -> list[str]:
    """Without tracks, hidden points bias the shift: then it is reported only where few can be hidden."""
    if shift is None or colors is None or colors < (FIT if tracked else _CLEAR):
        return []
    return _half_pixel("pixels: the pictures", shift.u, shift.v, shift.sigma)


def _half_pixel(what: str, u: float, v: float, sigma: float) -> list[str]:
    """One line, if the shift is that of a pixel convention."""
    size = max(abs(u), abs(v))
    if not (_SHIFT[0] < size < _SHIFT[1] and size > _SURE * sigma):
        return []
    return [
        f"{what} lie ({u:+.2f}, {v:+.2f}) px off the projections: a pixel's centre is at +0.5 here "
        "and was taken to be elsewhere"
    ]


def _nothing_fits(colors: float | None, patches: float) -> list[str]:
    if colors is None:
        problem = f"pictures: patches of the same points in two views hardly correlate ({patches:.2f})"
        return [f"{problem}; poses are wrong"] if patches < FIT else []
    if colors >= FIT:
        return []
    return [
        f"pictures: points and pixels hardly correlate ({colors:.2f}), nor in any other convention; "
        "are these the right images, and have the points colours?"
    ]
