"""Numbers in the text of notebooks: results are filled in by cells, and settings equal those of the package."""

import re
from pathlib import Path

import nbformat
import pytest

from zerobev.config import SCALES, CameraConfig, TextureConfig
from zerobev.evaluation.metrics import INTERVAL
from zerobev.report.paper import CLAIMS, PARAMETERS_M, TABLES

from support.paths import ROOT

RESULTS = sorted((ROOT / "notebooks").glob("0[5-9]_*.ipynb"))
#: A percentage, or a number with decimals; neither in code, formulas and targets of links, nor of a figure or section.
NUMBER = re.compile(r"(?<![\w.])(?<!Section )(?<!Theorem )\d+(?:\.\d+ ?%|\.\w+| ?%)")
UNREAD = re.compile(r"\$[^$]*\$|`[^`]*`|\[[^]]*\]\([^)]*\)|^#.*$", re.MULTILINE)


def text_of(path: Path) -> str:
    """The Markdown of a notebook."""
    cells = nbformat.read(path, as_version=4).cells
    return "\n".join(cell.source for cell in cells if cell.cell_type == "markdown")


def typed(text: str) -> set[str]:
    """The results that could be typed: percentages and decimals."""
    return set(NUMBER.findall(UNREAD.sub("", text)))


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_no_result_is_typed(path: Path):
    """Other numbers of this kind are the interval, ids of claims, and the fraction of white, the subject of Table 4."""
    interval = f"{100 * (INTERVAL[1] - INTERVAL[0]):.0f} %"
    white = {found[0] for row in TABLES[4].values() if (found := re.search(r"\d+ %", row.method))}
    assert len(white) == len(TABLES[4])
    assert typed(text_of(path)) <= {interval, *white, *(claim.id for claim in CLAIMS)}


def test_typed_results_are_found():
    text = "Section 3.4, Theorem 3.1, `x = 0.5` [1.2](1.3)\n# 10.1\n$0.9$, but 58 % and 24.9 points; claim 1.1, 12.5 %"
    assert typed(text) == {"58 %", "24.9", "1.1", "12.5 %"}


def settings() -> list[tuple[str, str]]:
    """Notebook -> a phrase with numbers of the package's settings."""
    camera, texture, paper = CameraConfig(fpv_px=1, bev_px=1), TextureConfig(), SCALES["paper"]
    size = f"{camera.bev_extent_m:g} m x {camera.bev_extent_m:g} m"
    rate = f"{paper.train.learning_rate:.0e}".replace("e-0", "e-")
    millions = sorted({f"{number:g}" for number in PARAMETERS_M.values()}, reverse=True)
    return [
        ("00", f"from above, {size} in front of the camera"),
        ("01", f"The map covers {size} in front of the camera"),
        ("01", f"the wedge has {camera.hfov_deg:g} degrees"),
        ("01", f"obstacles are higher than {100 * camera.obstacle_m:g} cm"),
        ("02", f"{100 * texture.white_fraction:g} % for *Synth*"),
        ("02", f"{100 * texture.modsem_fraction:g} % for *Mod. Sem.*"),
        ("02", f"until {100 * texture.modsem_fraction:g} % of the texels are white"),
        ("02", f"higher than {100 * camera.obstacle_m:g} cm"),
        ("03", f"{millions[0]} million parameters for Zero-BEV and TIM, and {millions[1]} million for VPN"),
        ("04", f"the first rate, {rate}, and the decay, {paper.train.decay:g}"),
        ("04", f"at the scale `paper` {paper.train.steps // paper.train.decay_every} epochs with a decay per epoch"),
        ("10a", f"is lower than {camera.max_height_m:g} m"),
        ("11", f"not level at {camera.height_m:g} m above the floor"),
    ]


@pytest.mark.parametrize(("number", "phrase"), settings())
def test_settings_in_prose_are_those_of_the_package(number: str, phrase: str):
    (path,) = (ROOT / "notebooks").glob(f"{number}_*.ipynb")
    assert phrase in " ".join(text_of(path).split())
