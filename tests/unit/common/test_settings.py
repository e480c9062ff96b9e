"""Settings from text: values have the right type; unknown names and wrong types are clear errors."""

import re

import pytest

from zerobev.common.errors import InputError
from zerobev.common.settings import changed_by
from zerobev.config import SCALES

REDUCED = SCALES["reduced"]


def test_values_of_every_type():
    found = changed_by(
        REDUCED,
        ["train.steps=2400", "train.decay = 1", "model.channels=(8, 16, 32, 64)", "model.block=bottleneck",
         "model.ground_start=False", "test_views=None", "texture.scales=(0.5, 2)", "name='mine'"],
    )  # fmt: skip
    assert (found.train.steps, found.train.decay, found.model.channels) == (2400, 1.0, (8, 16, 32, 64))
    assert type(found.train.decay) is float
    assert (found.model.block, found.model.ground_start, found.test_views) == ("bottleneck", False, None)
    assert found.texture.scales == (0.5, 2) and found.name == "mine"
    assert found.camera is REDUCED.camera and changed_by(REDUCED, []) is REDUCED


@pytest.mark.parametrize(
    "setting, message",
    [
        ("train.steps", "setting: expected name=value, found 'train.steps'"),
        ("train.step=3", "expected one of steps, learning_rate, .*, found 'step'"),
        ("train.steps=3.5", "expected int, found '3.5'"),
        ("train.steps=True", "expected int, found 'True'"),
        ("train.steps=many", "expected int, found 'many'"),
        ("train=3", "expected a value of train, such as train.steps"),
        ("name.first=3", "expected no name below name, found 'first'"),
        ("model.block=residual", "expected .*basic.*bottleneck.*, found 'residual'"),
        ("texture.scales=(1.0,)", "expected tuple.*, found"),
        ("train.steps=0", "steps: expected 1 or more, found 0"),
        ("camera.hfov_deg=180", "hfov_deg: expected more than 0 and less than 180, found 180"),
    ],
)
def test_unknown_names_and_wrong_types_are_refused(setting, message):
    with pytest.raises(InputError, match=message) as caught:
        changed_by(REDUCED, [setting])
    assert re.search(re.escape(setting.partition("=")[0]), str(caught.value))
