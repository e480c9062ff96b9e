"""Charts of an annotation: its textures as instance ids, with the wrap modes of their samplers."""

from pathlib import Path

import numpy as np
from PIL import Image

from zerobev.common.errors import InputError
from zerobev.scenes.gltf import CLAMP, MIRROR, rgba
from zerobev.scenes.scene import texel_of_uv

_MAX_SIDE = 32767  # of a chart: texels are stored as int16
_MAX_TEXELS = 1 << 27  # of a chart with a repeated texture
_MAX_UV = 1e6  # float32 does not resolve texels beyond
_SLACK_TEXELS = 0.1  # rounding beyond the border of a texture
_SAMPLES = 1 << 16
_MAX_FOREIGN = 0.05  # fraction of the surface


class Charts:
    """Collects faces with their textures; `build` returns the atlas of a `Scene`.

    id_of_color: (2^24,) uint16, instance id of each colour, red in the lowest byte, 0 for colours of no instance
    bad_rows: number of unreadable rows of the list; as many colours of no instance are accepted
    """

    def __init__(self, path: Path, id_of_color: np.ndarray, bad_rows: int = 0) -> None:
        self._path, self._id_of_color, self._bad_rows = path, id_of_color, bad_rows
        self._keys: dict[tuple[int, int, int], int] = {}
        self._images: list[Image.Image] = []
        self._face_uv: list[np.ndarray] = []
        self._face_chart: list[int] = []

    def add(self, image: Image.Image, wrap: tuple[int, int], face_uv: np.ndarray) -> None:
        """Add faces: their texture, its wrap modes (of u, of v) and their UV coordinates ((F, 3, 2), v down)."""
        if not (np.abs(face_uv) <= _MAX_UV).all():
            raise InputError(f"{self._path}: expected UV coordinates of at most {_MAX_UV:.0e}, found larger ones")
        axes = [_in_first_period(face_uv[..., k], wrap[k], image.size[k]) for k in (0, 1)]
        key = (id(image), axes[0][1], axes[1][1])
        if key not in self._keys:
            self._keys[key] = len(self._keys)
            self._images.append(image)
        self._face_uv.append(np.stack([uv for uv, _ in axes], axis=-1))
        self._face_chart.append(self._keys[key])

    def build(self, corners: np.ndarray) -> dict[str, np.ndarray | tuple[np.ndarray, ...]]:
        """The fields `face_uv`, `face_chart` and `chart_instance` of a scene; `corners` (F, 3, 3) are its faces'.

        Charts are in the order of their first face. A texture that repeats over a face is repeated in its chart.
        Colours of no instance on more than 5 % of the surface are an `InputError`; black means "unknown".
        """
        ids, foreign = [], []
        for chart, (_, *modes) in enumerate(self._keys):
            codes = _color_codes(self._path, self._images[chart])
            mine = [n for n, other in enumerate(self._face_chart) if other == chart]
            uniform = (codes == codes[0, 0]).all()
            for k, mode in enumerate(modes):
                size = codes.shape[1 - k]
                slack = _SLACK_TEXELS / size
                max_uv = max((float(self._face_uv[n][..., k].max(initial=1)) for n in mine), default=1.0)
                tiles = 1 if mode == CLAMP or uniform else int(np.ceil(max_uv - slack))
                if size * tiles > _MAX_SIDE or codes.size * tiles > max(_MAX_TEXELS, codes.size):
                    found = f"{size} repeated {tiles} times"
                    raise InputError(f"{self._path}: expected at most {_MAX_SIDE} texels per side, found {found}")
                codes = _tiled(codes, tiles, mode, axis=1 - k)
                if tiles > 1:
                    for n in mine:
                        self._face_uv[n][..., k] /= tiles
            ids.append(self._id_of_color[codes])
            foreign.append(np.where(ids[-1] == 0, codes, 0))
        face_uv = np.concatenate(self._face_uv)
        counts = [len(uv) for uv in self._face_uv]
        face_chart = np.repeat(np.array(self._face_chart, np.int16), counts)
        fraction = _foreign_fraction(foreign, corners, face_uv, face_chart, self._bad_rows)
        if fraction > _MAX_FOREIGN:
            raise InputError(
                f"{self._path}: expected the colors of the list's rows, found others on {fraction:.0%} of the surface: "
                "the texture was compressed with loss or resized, or the list is another home's"
            )
        return {"face_uv": face_uv, "face_chart": face_chart, "chart_instance": tuple(ids)}


def _in_first_period(uv: np.ndarray, mode: int, size: int) -> tuple[np.ndarray, int]:
    """One coordinate (F, 3) of faces, moved by whole periods to start in the first, and the remaining wrap mode."""
    slack = _SLACK_TEXELS / size
    outside = (uv < -slack).any(axis=1) | (uv > 1 + slack).any(axis=1)
    if mode == CLAMP or not outside.any():
        return uv, CLAMP
    period = 2 if mode == MIRROR else 1
    moved = uv.copy()
    moved[outside] -= period * np.floor((uv[outside].min(axis=1, keepdims=True) + slack) / period)
    return moved, CLAMP if moved.max() <= 1 + slack else mode


def _tiled(image: np.ndarray, tiles: int, mode: int, axis: int) -> np.ndarray:
    if tiles == 1:
        return image
    odd = np.flip(image, axis) if mode == MIRROR else image
    return np.concatenate([odd if n % 2 else image for n in range(tiles)], axis=axis)


def _color_codes(path: Path, image: Image.Image) -> np.ndarray:
    """(rows, columns) uint32: the bytes of red, green and blue as one number, red lowest."""
    try:
        texels = rgba(image)
    except Exception as error:  # PIL raises many kinds of error for a damaged image
        raise InputError(f"{path}: expected readable textures, found one that is not: {error}") from error
    return np.ascontiguousarray(texels).view("<u4")[..., 0] & 0xFFFFFF


def _foreign_fraction(
    foreign: list[np.ndarray], corners: np.ndarray, face_uv: np.ndarray, face_chart: np.ndarray, excused: int
) -> float:
    """The fraction of a surface with colours of no instance, from samples evenly spaced in area.

    foreign: per chart, the code of such a colour or 0
    excused: number of these colours that do not count, the most frequent ones
    """
    a, b, c = np.moveaxis(corners.astype(np.float64), 1, 0)
    reached = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    if not reached[-1] > 0:
        return 0.0
    n = np.arange(_SAMPLES)
    face = np.minimum(np.searchsorted(reached, (n + 0.5) / _SAMPLES * reached[-1]), len(corners) - 1)
    # a low-discrepancy sequence on the unit square, folded into a triangle
    right, up = 0.7548776662466927 * n % 1, 0.5698402909980532 * n % 1
    right, up = np.where(right + up > 1, (1 - right, 1 - up), (right, up))
    weight = np.stack([1 - right - up, right, up], axis=1)
    uv = np.einsum("nc,nck->nk", weight, face_uv[face])
    found = []
    for chart, codes in enumerate(foreign):
        on = face_chart[face] == chart
        found.append(codes[texel_of_uv(uv[on], codes.shape)])
    code, count = np.unique(np.concatenate(found), return_counts=True)
    counted = np.sort(count[code != 0])[::-1][excused:]
    return float(counted.sum() / _SAMPLES)
