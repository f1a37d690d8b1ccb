"""Walls of houses: plaster or brick, with storeys of windows, shutters, doors and shop fronts."""

from dataclasses import dataclass

import numpy as np

from panolog.synthetic.noise import Floats, cell, fractal
from panolog.synthetic.paint import Bools, Color, mix, rgb, speckle

STOREY = 2.9  # metres
PITCH = 2.3  # metres between windows


@dataclass(frozen=True)
class Facade:
    """The four walls of a house around `center` (x, y) with half sizes `half`; its front faces y = 0."""

    center: tuple[float, float]
    half: tuple[float, float]
    storeys: int
    wall: Color
    trim: Color  # shutters and door
    brick: bool = False
    shop: bool = False  # a shop window instead of the ground floor's front
    salt: int = 0  # of the curtains

    def __call__(self, points: Floats, normals: Floats) -> Floats:
        """Albedo (3, N) of points (3, N) on the walls with the normals (3, N)."""
        x, y, z = points
        faces_y = np.abs(normals[1]) > 0.5
        along = np.where(faces_y, x - self.center[0], y - self.center[1])
        half = np.where(faces_y, np.float32(self.half[0]), np.float32(self.half[1]))
        front = faces_y & (normals[1] * self.center[1] < 0)
        color = self._wall(along, z, half)
        color = self._windows(color, along, z, half, front)
        return self._door(color, along, z, front)

    def _wall(self, along: Floats, z: Floats, half: Floats) -> Floats:
        stain = fractal(along + 3.3 * self.salt, z, 7.0)
        if self.brick:
            row = np.floor(z / 0.22)
            bricks = cell(along / 0.55 + 0.5 * (row % 2), row, self.salt)
            joint = (z % 0.22 < 0.035) | ((along / 0.55 + 0.5 * (row % 2)) % 1.0 < 0.06)
            color = mix(speckle(self.wall, 0.5 + 0.6 * bricks + 0.4 * stain), rgb("b5a592"), joint * 0.7)
        else:
            color = speckle(self.wall, 0.72 + 0.5 * stain)
        corner = (half - np.abs(along) < 0.3) & (z > 0.6)
        quoins = speckle(rgb("d8cfbe"), 0.75 + 0.35 * cell(along / 9, z / 0.45, self.salt + 1))
        color = mix(color, quoins, corner & ((z / 0.45) % 2 < 1))
        plinth = speckle(rgb("8d857b"), 0.7 + 0.5 * cell(along / 0.7, z / 0.3, self.salt + 2))
        color = mix(color, plinth, z < 0.6)
        band = (
            (np.abs(z - STOREY * np.round(z / STOREY)) < 0.09) & (z > 1) & (z < STOREY * self.storeys + 0.2)
        )
        dirt: Floats = 0.8 + 0.2 * np.clip(z / 1.5, 0, 1)
        return mix(color, rgb("ddd5c5"), band) * dirt

    def _windows(self, color: Floats, along: Floats, z: Floats, half: Floats, front: Bools) -> Floats:
        floor = np.floor(z / STOREY)
        count = np.maximum(np.floor((2 * half - 0.8) / PITCH), 1)
        phase = 0.5 * ((count + 1) % 2)
        slot = np.round(along / PITCH - phase)
        across = along - (slot + phase) * PITCH
        up = z - floor * STOREY - 1.62
        there = (floor < self.storeys) & (np.abs(slot + phase) <= (count - 1) / 2 + 0.01)
        there &= ~(front & (floor == 0)) if self.shop else ~(front & (floor == 0) & (np.abs(along) < 1.0))
        return self._window(color, there, across, up, cell(slot + half, floor, self.salt + 7))

    def _window(self, color: Floats, there: Bools, across: Floats, up: Floats, luck: Floats) -> Floats:
        """A window, 0.96 x 1.5 m, `across` and `up` (N,) from its middle; `luck` (N,) picks its curtains."""
        wide, high = np.abs(across), np.abs(up)
        louvre = 0.65 + 0.35 * (up % 0.19 > 0.06)
        shutter = (wide > 0.6) & (wide < 1.02) & (high < 0.8)
        color = mix(color, speckle(self.trim, louvre), there & shutter)
        color = mix(color, rgb("f1ece0"), there & (wide < 0.6) & (high < 0.87))
        glass = speckle(rgb("4a6076"), 0.55 + 0.5 * (up + 0.75) + 0.5 * luck)
        glass = mix(glass, rgb("cfc2a4"), (wide > 0.2 + 0.2 * luck) & (luck > 0.35))
        glass = glass * np.where(up > 0.62, np.float32(0.5), np.float32(1))  # the lintel's shadow
        panes = (wide < 0.48) & (high < 0.75) & (wide > 0.045) & (np.abs(up - 0.25) > 0.045)
        color = mix(color, glass, there & panes)
        return mix(color, rgb("b8ad9b"), there & (wide < 0.72) & (np.abs(up + 0.93) < 0.07))

    def _door(self, color: Floats, along: Floats, z: Floats, front: Bools) -> Floats:
        if self.shop:
            return self._shop(color, along, z, front)
        wide = np.abs(along)
        color = mix(color, rgb("e4dccb"), front & (wide < 0.78) & (z < 2.5))
        boards = speckle(self.trim, np.where(along % 0.24 < 0.04, np.float32(0.6), np.float32(0.95)))
        boards = mix(boards, rgb("6d8293"), (wide < 0.36) & (z > 1.5) & (z < 1.95))
        boards = mix(boards, rgb("e5c36a"), ((along - 0.42) ** 2 + (z - 1.1) ** 2) < 0.004)
        return mix(color, boards, front & (wide < 0.58) & (z < 2.25))

    def _shop(self, color: Floats, along: Floats, z: Floats, front: Bools) -> Floats:
        wide = np.abs(along)
        width = self.half[0] - 0.7
        color = mix(color, self.trim, front & (wide < width) & (z < 2.75))
        goods = 0.35 + 1.1 * cell(along / 0.5, z / 0.45, self.salt + 11) * (z < 1.6)
        inside = mix(
            speckle(rgb("57524c"), goods), rgb("f0d9a0"), (z > 1.75) & (cell(along / 0.9, 0 * z, 4) > 0.5)
        )
        panes = (wide < width - 0.15) & (z > 0.55) & (z < 2.3) & (along % 1.5 > 0.1)
        color = mix(color, inside, front & panes)
        letters = (np.abs(z - 2.53) < 0.1) & (wide < 1.6) & (cell(along / 0.13, 0 * z, self.salt) > 0.4)
        return mix(color, rgb("f4ead0"), front & letters)
