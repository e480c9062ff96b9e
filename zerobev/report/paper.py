"""The published numbers of the paper, and its claims about them, as data.

Monaci, Antsfeld, Chidlovskii, Wolf: Zero-BEV: Zero-shot Projection of Any First-Person Modality to BEV
Maps, 3DV 2024. IoU in percent; classes in the order of `zerobev.config.LABELS`. Depth of the simulator, "GT" in the
paper, is called true depth here, that of a network ("MDE", "predicted") estimated depth.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One row of a table of the paper."""

    table: int
    row: str  #: the paper's letter; if it has none, the letter of the model and the varied setting
    method: str
    per_class: tuple[float, ...]  #: IoU of the eight classes
    class_iou: float  #: column "Avg."
    pixel_iou: float  #: column "Pix Avg."


def _rows(table: int, *rows: tuple[str, str, str]) -> dict[str, Row]:
    parsed = {}
    for row, method, numbers in rows:
        *per_class, class_iou, pixel_iou = map(float, numbers.split())
        parsed[row] = Row(table, row, method, tuple(per_class), class_iou, pixel_iou)
    return parsed


_C = "8.1 58.4 23.6 35.5 35.1 11.5 13.3 7.8 24.2 58.2"
_D = "12.1 58.2 27.5 39.9 39.8 16.9 14.5 12.4 27.7 58.9"

#: table -> row -> numbers
TABLES: dict[int, dict[str, Row]] = {
    1: _rows(
        1,
        ("a.1", "P^-1 with true depth (oracle)", "14.8 32.3 41.4 43.2 36.0 45.0 21.3 28.7 32.8 42.7"),
        ("b.1", "VPN (not zero-shot)", "3.7 61.9 15.0 26.4 35.9 7.0 13.8 6.6 21.3 61.1"),
        ("b.2", "TIM (not zero-shot)", "5.8 67.5 21.3 30.5 39.5 9.8 16.2 7.0 24.7 64.9"),
        ("b.3", "TIM with segmentation (not zero-shot)", "7.4 69.7 30.2 42.3 46.3 15.5 20.6 11.0 30.4 68.3"),
        ("a.2", "P^-1 with estimated depth", "9.8 32.2 26.0 34.7 31.1 18.1 15.2 15.6 22.8 39.7"),
        ("c", "Zero-BEV (+aux)", _C),
        ("d", "Zero-BEV (+aux, residual)", _D),
    ),
    2: _rows(
        2,
        ("-", "Zero-BEV", "7.2 57.1 21.7 33.5 33.8 10.1 12.3 6.3 22.8 57.7"),
        ("c", "+ aux (obstacles + navigable)", _C),
        ("c.I", "+ aux (obstacles)", "8.1 58.3 23.5 35.7 35.3 10.9 12.0 6.8 23.8 57.1"),
        ("c.II", "+ aux (navigable)", "8.0 58.0 23.0 34.9 34.9 9.9 12.2 5.9 23.4 57.8"),
        ("d", "+ aux (obstacles + navigable), residual", _D),
        ("d.I", "residual", "10.9 51.2 23.9 36.2 34.8 16.8 14.7 14.4 25.4 53.9"),
        ("e", "+ aux (obstacles + navigable), inductive bias", "8.0 59.0 21.9 33.9 34.7 9.9 12.3 5.8 23.2 56.9"),
    ),
    3: _rows(
        3,
        ("d.gt", "true depth", "11.2 57.4 26.0 39.2 38.5 16.9 15.5 15.2 27.5 56.8"),
        ("d.predicted", "estimated depth", "11.7 52.0 27.1 38.8 37.7 18.6 15.0 15.5 27.1 57.2"),
        ("d", "true, then estimated depth", _D),
    ),
    4: _rows(
        4,
        ("c.10", "10 % white", "7.9 56.0 23.7 34.3 33.9 11.4 12.7 7.7 23.5 58.5"),
        ("c.15", "15 % white", "8.7 56.4 23.6 35.6 35.0 11.2 12.9 7.4 23.9 58.8"),
        ("c", "20 % white", _C),
        ("c.25", "25 % white", "7.3 59.1 23.4 35.1 34.8 10.6 12.6 6.7 23.7 58.5"),
        ("c.30", "30 % white", "8.0 57.4 23.3 34.7 35.1 10.4 13.4 6.1 23.6 60.4"),
    ),
    5: _rows(
        5,
        ("c", "Synth (20 %)", _C),
        ("c.modsem", "Mod. Sem. (30 %)", "5.0 60.1 20.4 31.2 32.3 8.3 10.5 4.7 21.6 48.9"),
        ("c.depthproj", "Depth proj.", "8.7 32.2 22.5 29.5 27.8 12.4 13.9 7.7 19.3 41.7"),
    ),
}

#: parameters of each network, in millions (Table 1); (d) without the depth estimator
PARAMETERS_M = {"b.1": 15.0, "b.2": 41.0, "b.3": 41.0, "c": 41.0, "d": 41.0}

#: errors of the fine-tuned depth estimator of (a.2) and (d) on its validation images: metres, and relative to the true
#: depth (supplement)
DEPTH_ERRORS = {"mad_m": 0.13, "relative": 0.08}


@dataclass(frozen=True)
class Claim:
    """A statement of the paper about its numbers.

    metric: "class" or "pixel" average, the name of a class, or "objects", the mean of the six object classes
    """

    id: str  #: table and number
    metric: str
    text: str

    @property
    def table(self) -> int:
        """Number of the table, with which the id begins."""
        return int(self.id.split(".")[0])


@dataclass(frozen=True)
class Ordering(Claim):
    """Row `better` beats row `worse`."""

    better: str
    worse: str


@dataclass(frozen=True)
class Similar(Claim):
    """The lowest and the highest row differ by less than `points`."""

    rows: tuple[str, ...]
    points: float  #: IoU points, twice the spread in the paper's own table


#: Statements of the paper's Section 4 on the numbers of its tables, in the order of the tables. Its statements on
#: pictures and on single classes beside floor are not among them; notebook 5 compares the classes.
CLAIMS: tuple[Ordering | Similar, ...] = (
    Ordering("1.1", "class", "Zero-BEV beats the projection with estimated depth on class IoU", "c", "a.2"),
    Ordering("1.2", "pixel", "Zero-BEV beats the projection with estimated depth on pixel IoU", "c", "a.2"),
    Ordering(
        "1.3",
        "floor",
        "Zero-BEV beats it most on floor, which it infers where it is hidden",
        "c",
        "a.2",
    ),
    Ordering("1.4", "pixel", "Zero-BEV beats even the projection with true depth on pixel IoU", "c", "a.1"),
    Ordering("1.5", "class", "the residual model beats the base model on class IoU", "d", "c"),
    Ordering("1.6", "class", "the residual model beats TIM on class IoU", "d", "b.2"),
    Ordering("1.7", "class", "Zero-BEV beats VPN on class IoU", "c", "b.1"),
    Ordering(
        "1.8",
        "class",
        "TIM with the segmentation, an upper bound, beats the residual model",
        "b.3",
        "d",
    ),
    Ordering("2.1", "class", "auxiliary supervision helps the base model", "c", "-"),
    Ordering("2.2", "class", "auxiliary supervision helps the residual model", "d", "d.I"),
    Similar("2.3", "class", "which binary channel is supervised hardly matters", ("c.I", "c.II"), 0.8),
    Ordering("2.4", "class", "the inductive bias does not help where there is max-pooling", "c", "e"),
    Ordering("3.1", "class", "training on true, then estimated depth beats true depth alone", "d", "d.gt"),
    Ordering("3.2", "class", "training on true, then estimated depth beats estimated depth alone", "d", "d.predicted"),
    Similar("4.1", "class", "the fraction of white matters little", ("c.10", "c.15", "c", "c.25", "c.30"), 1.4),
    Ordering("5.1", "class", "Synth beats Mod. Sem.", "c", "c.modsem"),
    Ordering("5.2", "class", "Mod. Sem. beats Depth proj.", "c.modsem", "c.depthproj"),
    Ordering("5.3", "floor", "Mod. Sem. is better than Synth on floor", "c.modsem", "c"),
    Ordering("5.4", "objects", "Synth is better than Mod. Sem. on objects", "c", "c.modsem"),
)


@dataclass(frozen=True)
class Ratio:
    """A quotient of two rows of Table 1, which is comparable across data sets."""

    numerator: str
    denominator: str
    metric: str


RATIOS = tuple(
    Ratio(numerator, denominator, metric)
    for numerator, denominator in (("c", "a.1"), ("d", "a.1"), ("c", "b.3"), ("d", "b.3"))
    for metric in ("class", "pixel")
)
