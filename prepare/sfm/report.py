"""The result of `panolog scene sfm`: what it reports at its end and leaves in the scene as sfm.json."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from panolog.prepare.sfm.links import Link
from panolog.prepare.sfm.plot import write_sfm_plot
from panolog.prepare.sfm.reconstruct import Reconstruction
from panolog.prepare.sources.find import Source
from panolog.prepare.world.georeference import Georeference
from panolog.scene.files import write_bytes

WEAK = 0.01  # relative error of the scale across a link, by rays alone, from which it is reported


@dataclass(frozen=True)
class Into:
    """The scene that panoramas were added to."""

    scene: Path
    panoramas: int  # that it had: the first ones of the reconstruction


@dataclass(frozen=True, eq=False)
class SfmReport:
    """A reconstruction for users and programs."""

    found: Reconstruction  # in the scene's world
    world: Georeference
    notes: tuple[str, ...]  # of the source and of the world, one line each
    left_out: tuple[str, ...] = ()  # what of the source was not read, one line for each kind
    number: int = 1  # of the part
    sources: tuple[Source, ...] = ()  # in the order of capture, where there are several
    into: Into | None = None  # the scene that the sources were added to

    def as_json(self) -> dict[str, Any]:
        """The report as `--json` prints it. Errors are in pixels of the panoramas, scale errors relative."""
        model = self.found.model
        errors = model.errors(self.found.size[0])
        lengths = np.bincount(np.concatenate([rows for rows, _ in model.sightings]))
        lengths = lengths[lengths > 0]  # of a scene without observations there may be none
        return {
            "panoramas": len(self.found.panoramas),
            "registered": len(model.rows),
            "points": len(model.points),
            "observations": sum(map(len, errors)),
            "track_length": float(lengths.mean()),
            "error": float(np.concatenate(errors).mean()),
            "features": self.found.features,
            "pairs": self.found.pairs,
            "images": [
                {
                    "name": self._name(row),
                    "points": len(own),
                    "error": float(own.mean()) if len(own) else None,
                }
                for row, own in zip(model.rows, errors, strict=True)
            ],
            "missing": [
                {
                    "name": self._name(row),
                    "most_shared_with": self._name(other),
                    "matches": count,
                    "unconfirmed": row in self.found.unconfirmed,
                }
                for row, (other, count) in self.found.missing.items()
            ],
            "parts": [[self._name(row) for row in rows] for rows in self.found.others],
            "weak_links": [self._link(link) for link in self.found.links if link.scale_error >= WEAK],
            "contradictions": [
                {
                    "between": [self._name(row) for row in pair.between],
                    "matches": pair.matches,
                    "points": pair.points,
                    "reason": pair.reason,
                }
                for pair in self.found.contradictions
            ],
            "world": self._world(),
            "notes": list(self.notes),
            "left_out": list(self.left_out),
            **({"sources": [self._source(it) for it in self.sources]} if self.sources else {}),
            **({} if self.into is None else {"into": self._joined(self.into)}),
        }

    def lines(self) -> Iterator[str]:
        """The report as lines of text."""
        content = self.as_json()
        posed = f"{content['registered']} of {content['panoramas']} panoramas have a pose"
        if self.into is not None:
            it = content["into"]
            posed = f"{it['joined']} of {it['given']} panoramas joined the {it['panoramas']} of {it['scene']}"
        yield (
            f"{posed}, {content['points']:,} points, seen by {content['track_length']:.1f} panoramas, "
            f"{content['error']:.2f} pixels off"
        )
        for source in content.get("sources", ()):
            yield (
                f"{source['name']}, of {source['path']}: {source['registered']} of {source['panoramas']} "
                "panoramas have a pose"
            )
        for part in content["parts"]:
            yield (
                f"another part: {part[0]} to {part[-1]}, {len(part)} panoramas that agree, but are not "
                "connected to these. More panoramas between help; `panolog scene sfm --partial` writes each "
                "part as a scene"
            )
        elsewhere = {name for part in content["parts"] for name in part}
        for image in content["missing"]:
            if image["name"] in elsewhere:
                continue
            why = ", and no second pair confirms what one says" if image["unconfirmed"] else ""
            shared = f"at most {image['matches']} features, with {image['most_shared_with']}{why}"
            yield f"no pose: {image['name']} (shares {shared if image['matches'] else 'no features'})"
        for link in content["weak_links"]:
            jump = "by any factor" if link["scale_error"] is None else f"by {link['scale_error']:.1%}"
            yield (
                f"weak link: {link['between'][0]} to {link['between'][1]} holds {link['part']} panoramas by "
                f"{link['points']} points; the scale may jump there {jump}. More panoramas between them help"
            )
        for pair in content["contradictions"]:
            one, other = pair["between"]
            yield (
                f"contradiction: {one} and {other} {pair['reason']}: one of them stands elsewhere, as where "
                "windows repeat. Take more panoramas around them, or leave some out"
            )
        if self.into is None:
            yield self._frame()
        else:
            yield f"the world: that of {self.into.scene}, in which nothing has moved"
        yield from self.notes
        yield from self.left_out

    def _joined(self, into: Into) -> dict[str, Any]:
        """How many of the panoramas that were given have a pose in the scene."""
        given = len(self.found.panoramas) - into.panoramas
        joined = len(self.found.model.rows) - into.panoramas
        return {"scene": str(into.scene), "panoramas": into.panoramas, "given": given, "joined": joined}

    def _source(self, source: Source) -> dict[str, Any]:
        """How many of the panoramas of a source have a pose in this part."""
        of_it = [row for row, it in enumerate(self.found.panoramas) if it.source == source.label]
        return {
            "name": source.label,
            "path": str(source.path),
            "panoramas": len(of_it),
            "registered": len(set(of_it).intersection(self.found.model.rows)),
        }

    def _world(self) -> dict[str, Any]:
        content: dict[str, Any] = {
            "frame": self.world.frame,
            "metric": self.world.metric,
            "up_spread": self.world.up.spread,
        }
        gps = self.world.gps
        if gps is not None:
            content["gps"] = {
                "panoramas": gps.fixes.cameras,
                "places": len(gps.inliers),
                "fitting": int(gps.inliers.sum()),
                "spread": gps.spread,
                "residual": gps.residual,
                "vertical": gps.vertical,
                "doubt": gps.uncertainty,
            }
        return content

    def _frame(self) -> str:
        """The world as text."""
        gps = self.world.gps
        if gps is not None:
            return (
                f"the world: metres east, north and up, by the GPS of {gps.fixes.cameras} panoramas, which "
                f"it follows to {gps.residual:.1f} m; its scale is known to {gps.uncertainty:.1%}"
            )
        units = "metres" if self.world.metric else "of no known scale (--distance gives one)"
        axes = "z up" if self.world.frame == "upright" else "axes in any direction"
        return f"the world: {axes}, units {units}"

    def _name(self, row: int) -> str:
        return self.found.panoramas[row].name

    def _link(self, link: Link) -> dict[str, Any]:
        return {
            "between": [self._name(self.found.model.rows[row]) for row in link.between],
            "part": len(link.smaller),
            "points": link.points,
            "scale_error": link.scale_error if np.isfinite(link.scale_error) else None,
        }


def write_report(scene: Path, report: SfmReport) -> None:
    """Writes SCENE/sfm.json and SCENE/sfm.png. Raises OSError if they cannot be written."""
    write_bytes(scene / "sfm.json", json.dumps(report.as_json(), indent=1).encode() + b"\n")
    write_sfm_plot(scene / "sfm.png", report.found, WEAK)
