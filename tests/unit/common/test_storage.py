"""Atomic writes: whole or not at all, readable as any new file."""

import os

import pytest
import torch
from safetensors.torch import save_file

from zerobev.common.storage import replacing


@pytest.mark.parametrize("umask", [0o022, 0o027])
def test_a_written_file_has_the_permissions_of_a_new_one(tmp_path, umask):
    before = os.umask(umask)
    try:
        with replacing(tmp_path / "weights.safetensors") as temporary:
            save_file({"a": torch.zeros(1)}, temporary)
        (tmp_path / "new").touch()
    finally:
        os.umask(before)
    modes = [(tmp_path / name).stat().st_mode for name in ("weights.safetensors", "new")]
    assert modes[0] == modes[1]


def test_an_error_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "folder" / "text.txt"
    with replacing(path) as temporary:
        temporary.write_text("old")
    with pytest.raises(ValueError, match="stop"), replacing(path) as temporary:
        temporary.write_text("half")
        raise ValueError("stop")
    assert path.read_text() == "old" and list(path.parent.iterdir()) == [path]
