"""Numbers of a glTF 2.0 file: buffers, buffer views and accessors, decoded by the specification.

trimesh reads neither normalized integers nor sparse values; other Python libraries do not decode accessors.
"""

import base64
import binascii
from pathlib import Path
from typing import Any

import numpy as np

from zerobev.common.errors import InputError

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_INDICES = (5121, 5123, 5125)
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MAX_ELEMENTS = 1 << 24  # of a sparse accessor: a short header could demand more than the memory


class Accessors:
    """The arrays of a glTF file, from its JSON header and binary chunk. Every fault is an `InputError`."""

    def __init__(self, path: Path, header: dict[str, Any], binary: bytes) -> None:
        self._path, self._header, self._binary = path, header, binary
        self._buffers: dict[int, bytes] = {}

    def error(self, expected: str, found: str) -> InputError:
        """The error for `found` in place of `expected` in the file."""
        return InputError(f"{self._path}: expected {expected}, found {found}")

    def item(self, kind: str, index: Any) -> Any:
        """Entry `index` of the header's list `kind`."""
        items = self._header.get(kind, [])
        if type(index) is not int or not 0 <= index < len(items):
            raise self.error(f"an index below {len(items)} into {kind}", repr(index)[:40])
        return items[index]

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            buffer = self.item("buffers", index)
            if "uri" in buffer:
                self._buffers[index] = self.data(buffer["uri"])
            elif index == 0:
                self._buffers[index] = self._binary
            else:
                raise self.error("buffers in the file", f"none for buffer {index}")
        return self._buffers[index]

    def data(self, uri: str) -> bytes:
        """The bytes of a data URI; other files are not read."""
        kind, comma, text = uri.partition(",")
        if not (kind.startswith("data:") and kind.endswith(";base64") and comma):
            raise self.error("buffers and images within the file or as data URI", repr(uri[:40]))
        try:
            return base64.b64decode(text, validate=True)
        except binascii.Error as error:
            raise self.error("a data URI in base64", str(error)) from error

    def view(self, index: int) -> memoryview:
        """The bytes of a buffer view."""
        view = self.item("bufferViews", index)
        start, length = view.get("byteOffset", 0), view["byteLength"]
        content = self._buffer(view["buffer"])
        if start < 0 or length < 0 or start + length > len(content):
            raise self.error(f"buffer view {index} within {len(content)} bytes", f"{length} bytes at {start}")
        return memoryview(content)[start : start + length]

    def _rows(self, view: int, offset: int, count: int, kind: str, width: int, stride: int | None) -> np.ndarray:
        """(count, width) numbers of a buffer view, `stride` bytes apart (None: adjacent)."""
        content, size = self.view(view), np.dtype(kind).itemsize
        stride = size * width if stride is None else stride
        fits = offset >= 0 and count >= 0 and stride >= size * width and stride % size == 0
        if not fits or (count and offset + (count - 1) * stride + size * width > len(content)):
            found = f"{count} rows {stride} bytes apart, from byte {offset} of {len(content)}"
            raise self.error(f"rows of {width} numbers within buffer view {view}", found)
        if not count:
            return np.zeros((0, width), kind)
        return np.ndarray((count, width), kind, content, offset, (stride, size)).copy()

    def numbers(self, index: int, forms: tuple[str, ...]) -> tuple[np.ndarray, bool]:
        """(count, width) numbers with their stored type, and whether they are normalized."""
        accessor = self.item("accessors", index)
        kind, count, sparse = _TYPES[accessor["componentType"]], accessor["count"], accessor.get("sparse")
        if accessor["type"] not in forms:
            raise self.error(f"{' or '.join(forms)} in accessor {index}", str(accessor["type"]))
        width = _WIDTHS[accessor["type"]]
        if "bufferView" in accessor:
            stride = self.item("bufferViews", accessor["bufferView"]).get("byteStride")
            start = accessor["bufferView"], accessor.get("byteOffset", 0)
            numbers = self._rows(*start, count, kind, width, stride)
        elif sparse is None:
            raise self.error("data that is not compressed", f"none for accessor {index}")
        elif not 0 <= count <= _MAX_ELEMENTS:
            raise self.error(f"at most {_MAX_ELEMENTS} elements in sparse accessor {index}", str(count))
        else:
            numbers = np.zeros((count, width), kind)
        if sparse is not None:
            indices, values, changed = sparse["indices"], sparse["values"], sparse["count"]
            if indices["componentType"] not in _INDICES:
                raise self.error("unsigned integers as sparse indices", str(indices["componentType"]))
            start = indices["bufferView"], indices.get("byteOffset", 0)
            rows = self._rows(*start, changed, _TYPES[indices["componentType"]], 1, None)[:, 0]
            if changed and rows.max() >= count:
                raise self.error(f"sparse indices below {count} in accessor {index}", str(rows.max()))
            start = values["bufferView"], values.get("byteOffset", 0)
            numbers[rows] = self._rows(*start, changed, kind, width, None)
        return numbers, accessor.get("normalized", False)

    def floats(self, index: int, *forms: str, normalized: bool = False) -> np.ndarray:
        """(count, width) float32; with `normalized`, integers are normalized regardless of the accessor."""
        numbers, flag = self.numbers(index, forms)
        if numbers.dtype.kind != "f" and (flag or normalized):
            # the quotient is rounded once, in float64
            return np.maximum(numbers / np.iinfo(numbers.dtype).max, -1.0).astype(np.float32)
        return numbers.astype(np.float32)
