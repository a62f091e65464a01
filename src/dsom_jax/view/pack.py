"""From a story to the one JSON inside a page: small integers in base64, the map as a PNG."""

from __future__ import annotations

import base64
import io
from typing import Any

import numpy as np
from PIL import Image

from dsom_jax.view.story import VERDICTS, DriveStory, Field, Plan, Story, fewer_particles, moments

PARTICLE_BYTES = 420_000
"""What the particles of all drives together may take before base64, which adds a third."""
SCAN_BYTES = 120_000
"""What their scans may take."""
_PER_PARTICLE = 6  # two int16, two uint8
_NO_RETURN = 65535


def pack(story: Story) -> dict[str, Any]:
    """The JSON of a page; arrays are little-endian, in base64."""
    origin, scale = _quantum(story)
    updates = sum(len(drive.stamps) for drive in story.drives)
    particles = max(1, PARTICLE_BYTES // (_PER_PARTICLE * max(updates, 1)))
    step = max(1, -(-2 * len(story.plan.bearings) * updates // SCAN_BYTES))
    reach = max([1.0, *(float(d.ranges[np.isfinite(d.ranges)].max(initial=1.0)) for d in story.drives)])
    return {
        "map": _map(story.plan),
        "view": _rounded(_box(story.plan)),
        "bearings": _encoded(story.plan.bearings[::step], "<f4"),
        "mount": list(story.plan.mount),
        "quantum": {"x": origin[0], "y": origin[1], "scale": scale},
        "range": reach / (_NO_RETURN - 1),
        "verdicts": VERDICTS,
        "drives": [_drive(d, particles, step, reach, origin, scale) for d in story.drives],
        "overlay": _overlay(story.overlay) if story.overlay else None,
        "lookalikes": [{"a": _rounded(p.a), "b": _rounded(p.b)} for p in story.lookalikes],
    }


def _drive(
    drive: DriveStory, particles: int, step: int, reach: float, origin: np.ndarray, scale: float
) -> dict[str, Any]:
    """One drive."""
    poses, weights = fewer_particles(drive, particles)
    steps = np.clip(np.rint((poses[..., :2] - origin) / scale), -32767, 32767)
    # Turns in 256ths, weights in units of the greatest of the same update.
    turns = np.rint(poses[..., 2] / (2 * np.pi) * 256) % 256
    shares = weights / np.maximum(weights.max(1, keepdims=True, initial=0.0), 1e-30)
    e_pos, e_theta = drive.errors()
    scan = drive.ranges[:, ::step]
    seen = np.isfinite(scan)
    codes = np.where(seen, np.rint(np.where(seen, scan, 0) / reach * (_NO_RETURN - 1)), _NO_RETURN)
    index = {name: number for number, name in enumerate(VERDICTS)}
    return {
        "name": drive.name,
        "stamps": _encoded(np.asarray(drive.stamps, float) - float(drive.stamps[0]), "<f4"),
        "estimates": _encoded(drive.estimates, "<f4"),
        "truth": _encoded(drive.truth, "<f4") if np.isfinite(drive.truth).any() else None,
        "errorPosition": _encoded(e_pos, "<f4"),
        "errorHeading": _encoded(e_theta, "<f4"),
        "lost": _encoded(drive.p_lost, "<f4"),
        "verdict": _encoded(np.array([index[name] for name in drive.verdicts]), "u1"),
        "kidnapped": [int(t) for t in np.flatnonzero(drive.kidnapped) if t > 0],
        "ranges": _encoded(codes, "<u2"),
        "particles": {"count": poses.shape[1], "xy": _encoded(steps, "<i2"), "turn": _encoded(turns, "u1"),
                      "weight": _encoded(np.rint(255 * shares), "u1")},
        "hypotheses": _hypotheses(drive),
        "moments": [moment._asdict() for moment in moments(drive)],
    }  # fmt: skip


def _hypotheses(drive: DriveStory) -> dict[str, Any]:
    """Rows (weight, x, y, theta, var x, cov xy, var y, var theta) of all updates, and how many each update has."""
    weights, means, cov = (np.asarray(part, float) for part in drive.hypotheses)
    there = weights > 0
    parts = (weights, means, cov[..., 0, 0], cov[..., 0, 1], cov[..., 1, 1], cov[..., 2, 2])
    rows = np.concatenate([part.reshape(*there.shape, -1) for part in parts], -1)[there]
    return {"counts": _encoded(there.sum(1), "<u2"), "rows": _encoded(rows, "<f4")}


def _map(plan: Plan) -> dict[str, Any]:
    """Pixels 0 unknown, 128 free, 255 occupied; the page gives them the colours of its theme."""
    pixels = np.where(plan.occupied, 255, np.where(plan.free, 128, 0)).astype(np.uint8)
    return {"png": _png(pixels[::-1]), "resolution": plan.resolution, "origin": [float(v) for v in plan.origin]}


def _overlay(layer: Field) -> dict[str, Any]:
    """Pixels 0 for nothing, 1 to 255 from the least to the greatest value."""
    known = np.isfinite(layer.values)
    low, high = (float(layer.values[known].min()), float(layer.values[known].max())) if known.any() else (0.0, 1.0)
    level = 1 + np.rint(254 * (np.where(known, layer.values, low) - low) / max(high - low, 1e-9))
    pixels = np.where(known, level, 0).astype(np.uint8)
    return {"png": _png(pixels[::-1]), "resolution": layer.resolution, "origin": [float(v) for v in layer.origin],
            "label": layer.label, "unit": layer.unit, "low": low, "high": high}  # fmt: skip


def _quantum(story: Story) -> tuple[np.ndarray, float]:
    """Where quantised positions begin (2,), and metres per step: 1.6 mm on 33 m, and as far again around."""
    box = _box(story.plan)
    middle, reach = (box[:2] + box[2:]) / 2, max(float((box[2:] - box[:2]).max()), 1.0)
    return middle, reach / 20000


def _box(plan: Plan) -> np.ndarray:
    """(4,) least x and y, greatest x and y of what is known of the map."""
    corners = plan.corners()
    return np.concatenate([corners.min(0), corners.max(0)])


def _png(pixels: np.ndarray) -> str:
    """Data URI of grey pixels (H, W), first row at the top."""
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(content.getvalue()).decode()


def _encoded(values: Any, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode()


def _rounded(values: Any) -> list[float]:
    return [round(float(v), 4) for v in values]
