"""Where the checkout and, beside it, material that is not part of it are."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: The paper's source, HM3DSem's table of names, two real homes: tests that use them skip where they are absent.
SHARED = ROOT.parent / "shared"
REAL_HOMES = SHARED / "scenes/hm3dsem"
