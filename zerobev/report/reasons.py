"""Why a claim turned out as it did, and an experiment that would change it: prose per claim and verdict.

A reason is shown only beside the verdict that it explains, so a new verdict hides it. "Seen here" is a number of the
workbook; "probable" is not tested.
"""

from collections.abc import Mapping

from zerobev.report.claims import VerdictName

#: id of a claim -> verdict -> sentences
REASONS: Mapping[str, Mapping[VerdictName, str]] = {
    "1.1": {
        "undecided": "Seen here: the network gains on floor, the projection is better for small objects, as in the "
        "paper, and the class average weighs all classes alike. Probable remedies: longer training, larger images."
    },
    "1.8": {
        "undecided": "Seen here: the trainings of (b.3) differ much from seed to seed, and its validation loss still "
        "falls at the end. Probable remedy: longer training.",
        "does not hold": "Seen here: the validation loss of (b.3) still falls at the end. Probable remedy: longer "
        "training.",
    },
    "2.2": {"undecided": "Probable: the projection already marks the cells with something on them."},
    "3.1": {
        "does not hold": "Seen here: true depth in training is better for objects, two stages for floor. "
        "Class IoU rewards the first, pixel IoU the second. Probable: true depth teaches the network to copy the "
        "projection, estimated depth to smooth it. A better estimator would bring the rows together.",
    },
    "4.1": {
        "undecided": "Seen here: the row with the least white is the lowest. The interval includes the limit, which is "
        "twice the paper's own spread. Probable: little white is a weak signal for a short training.",
        "does not hold": "Seen here: the row with the least white is the lowest. Probable: little white is a weak "
        "signal for a short training.",
    },
    "5.2": {
        "does not hold": "Seen here: Mod. Sem. is better on floor, as in the paper, but loses on wall and on objects; "
        "the smallest classes are not marked at all. Probable: its textures follow the objects, so the photograph "
        "predicts them (notebook 2), and the network reads the mask less. One texture per home is not enough as a "
        "reason, since row (c.once) has that, too. To test: a new erosion per sample."
    },
    "5.3": {
        "does not hold": "Seen here: the network trained on Mod. Sem. marks about half of the floor. An eroded floor "
        "is white only in its middle. We erode object by object, and the paper's scans have other outlines: the two "
        "data sets are not the same."
    },
    "6.1": {"undecided": "At this length of training, the size of structures makes no clear difference."},
    "6.3": {"undecided": "Probable: many homes, each with its own texture, are variety enough."},
}
