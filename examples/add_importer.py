"""Imports a format that PanoLOG does not know: panoramas with positions and headings in a CSV file.

    python examples/add_importer.py SOURCE SCENE

SOURCE/poses.csv has the columns name, x, y, z (metres, z up) and heading (degrees, clockwise from y);
SOURCE/points.csv has x, y, z, red, green, blue (0 to 255). The panoramas are in SOURCE/images.
"""

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import panolog

UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # z up -> y down, y ahead -> z ahead


def detect(source: panolog.ImportSource) -> bool:
    """Whether a source is of this format; looks at names only."""
    return source.first("poses.csv") is not None


def read(source: panolog.ImportSource) -> panolog.ImportedScene:
    """Poses and points in PanoLOG's convention."""
    images = [_posed(source, row) for row in _rows(source.folder / "poses.csv")]
    table = [[float(value) for value in row.values()] for row in _rows(source.folder / "points.csv")]
    points = np.array(table).reshape(-1, 6)
    return panolog.ImportedScene(images, points=points[:, :3], colors=points[:, 3:].astype(np.uint8))


def _posed(source: panolog.ImportSource, row: dict[str, str]) -> panolog.PosedImage:
    """World-to-camera: X_cam = rotation @ X + translation, with camera axes x right, y down, z forward."""
    turn = Rotation.from_euler("z", float(row["heading"]), degrees=True).as_matrix()
    rotation: NDArray[np.float64] = UPRIGHT @ turn
    center = np.array([float(row[axis]) for axis in "xyz"])
    name, file = panolog.find_panorama("poses.csv", [source.images or source.folder / "images"], row["name"])
    return panolog.PosedImage(name, file, rotation, -rotation @ center)


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def main(arguments: Sequence[str] | None = None) -> None:
    """Registers the format and imports a scene of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("source", metavar="SOURCE", type=Path)
    parser.add_argument("scene", metavar="SCENE", type=Path)
    options = parser.parse_args(arguments)

    panolog.register_format("csv", panolog.ImportFormat(detect, read))
    source = panolog.ImportSource(options.source)
    report = panolog.import_scene(source, options.scene)  # finds the format by itself
    print(f"{options.scene}: {report.panoramas} panoramas, {report.points} points, from {report.format}")


if __name__ == "__main__":
    main()
