"""A page of ``view`` as a test sees it: its figures, and where the camera shows points."""

import json
import re

import numpy as np

from xpbd_ros.view.stage import EYE, FIELD_OF_VIEW, PANEL

SHEET = """
cloths:
  sheet:
    grid: {size: [0.6, 0.6], resolution: [7, 7]}
    pose:
      position: [0.0, 0.0, 1.0]
      orientation: [0.7071067811865476, 0.0, 0.0, 0.7071067811865476]
    density: 0.2
    effects: {stretch: {warp: 300.0, weft: 300.0}, shear: {stiffness: 30.0}}
pins:
  left: {cloth: sheet, at: corner_10}
  right: {cloth: sheet, at: corner_11}
effects: {damping: {rate: 3.0}}
solver: {method: gauss_seidel, integrator: backward_euler, substeps: 8}
"""
"""a sheet that hangs from its upper corners"""
CENTRE, SIZE = np.array([0.3, 0.0, 1.3]), 0.6
"""of the sheet at its start [m]"""


def pins(page) -> dict[str, tuple]:
    """Return force [N] and position [m] of each pin that the page shows."""
    found = {}
    for line in page.text().splitlines():
        match = re.fullmatch(r'(\w+): (\S+) N at (\S+), (\S+), (\S+) m', line)
        if match:
            found[match[1]] = float(match[2]), tuple(map(float, match.groups()[2:]))
    return found


def pixel(page, point) -> tuple[float, float]:
    """Return where a point [m] is seen by the camera of the page's start."""
    forward = -np.array(EYE) / np.linalg.norm(EYE)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    away = point - (CENTRE + SIZE * np.linalg.norm(EYE) * (PANEL * right - forward))
    width, height = json.loads(page.value('JSON.stringify([innerWidth, innerHeight])'))
    scale = 0.5 * height / np.tan(0.5 * FIELD_OF_VIEW) / (away @ forward)
    return (0.5 * width + scale * (away @ right),
            0.5 * height - scale * (away @ np.cross(right, forward)))


def drag(page, begin, end, *, steps: int = 15) -> None:
    """Drag from a point to another [m]; both are seen by the camera of the page's start."""
    grip, goal = pixel(page, begin), pixel(page, end)
    page.drag(grip, *(tuple(np.add(grip, share * np.subtract(goal, grip)))
                      for share in np.linspace(0.1, 1.0, steps)))


def is_blue(pixel) -> bool:
    """Return whether a pixel is of the first cloth."""
    return pixel[2] > pixel[0] + 0.15


def blue(picture: np.ndarray) -> float:
    """Return the part of a picture that is of the first cloth."""
    return float((picture[..., 2] > picture[..., 0] + 0.15).mean())


def red(picture: np.ndarray) -> float:
    """Return the part of a picture that is red."""
    return float((picture[..., 0] > picture[..., 2] + 0.15).mean())
