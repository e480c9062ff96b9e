"""Masks, labels, probabilities: explicit kinds, and plain arrays of an unambiguous kind."""

import io

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from zerobev.common.errors import InputError
from zerobev.inference import Labels, Masks, Probabilities
from zerobev.inference.modality import Modality
from zerobev.inference.plain_arrays import kind_of
from zerobev.inference.probabilities import LEVELS

SHAPE = (20, 30)
MASK = np.zeros(SHAPE, bool)
MASK[5:15, 3:20] = True
STACK = np.stack([MASK, ~MASK, np.zeros_like(MASK), MASK[::-1], MASK[:, ::-1]])
CLASSES = np.arange(600).reshape(SHAPE) // 100
VOC = np.where(MASK, 7, 0)
VOC[:, -1] = 255


def seen(kind: Modality, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """The binary images of a kind with one layer."""
    (layer,) = kind.layers(shape)
    return np.stack(list(layer.images))


def jpeg(mask: np.ndarray) -> np.ndarray:
    """A mask after JPEG, as grey values near 0 and 255."""
    stream = io.BytesIO()
    Image.fromarray(mask.astype(np.uint8) * 255).save(stream, "JPEG", quality=75)
    return np.asarray(Image.open(stream))


def test_labels_become_masks_and_values_their_level_sets():
    labels = np.array([[2, 2, -1], [0, 7, 7]])
    (images,) = Labels(labels, {0: "wall", 2: "bed", 7: "tv"}).layers((2, 3))
    assert images.labels == ("wall", "bed", "tv") and images.levels == 1
    np.testing.assert_array_equal(np.stack(list(images.images)), np.stack([labels == k for k in (0, 2, 7)]))
    values = np.linspace(0, 1, 6).reshape(2, 3).astype(np.float32)
    (images,) = Probabilities(values).layers((2, 3))
    assert images.levels == LEVELS and images.labels == ("0",)
    assert np.abs(np.mean(list(images.images), axis=0) - values).max() <= 0.5 / LEVELS + 1e-6


@pytest.mark.parametrize(
    "code",
    [
        lambda m: m,
        lambda m: m.astype(np.uint8),
        lambda m: m.astype(np.uint8) * 255,
        lambda m: m.astype(np.uint16) * 65535,
        lambda m: m.astype(np.float32),
        lambda m: torch.from_numpy(m.astype(np.uint8) * 255),
        lambda m: torch.from_numpy(m.astype(np.float32)).bfloat16().requires_grad_(),
        lambda m: m.tolist(),
    ],
)
def test_masks_are_the_same_in_every_common_type(code):
    np.testing.assert_array_equal(seen(Masks(code(MASK))), MASK[None])
    np.testing.assert_array_equal(seen(Masks(code(STACK))), STACK)
    np.testing.assert_array_equal(seen(Masks(code(np.moveaxis(STACK, 0, -1)))), STACK)
    np.testing.assert_array_equal(seen(Masks([code(mask) for mask in STACK])), STACK)


def test_a_mask_after_jpeg_is_thresholded_at_one_half():
    row, column = np.mgrid[:160, :240]
    disc = np.hypot(row - 70, column - 90) < 45
    noisy = jpeg(disc)
    assert len(np.unique(noisy)) > 50
    np.testing.assert_array_equal(seen(Masks(noisy), disc.shape), disc[None])


@pytest.mark.parametrize("axis", ["first", "last"])
def test_channels_are_first_or_last_as_given(axis):
    values = np.random.default_rng(0).random((6, 6, 6))
    first = values if axis == "first" else np.moveaxis(values, -1, 0)
    np.testing.assert_array_equal(
        seen(Probabilities(values, channels=axis), (6, 6)), seen(Probabilities(first, channels="first"), (6, 6))
    )
    with pytest.raises(InputError, match="expected channels first or last, found both"):
        Probabilities(values).layers((6, 6))
    with pytest.raises(InputError, match="expected channels first or last, found both"):
        kind_of(values, (6, 6)).layers((6, 6))
    softmax = torch.rand(*SHAPE, 5).softmax(dim=-1)
    for given_ in (softmax, softmax.permute(2, 0, 1)):
        np.testing.assert_array_equal(seen(kind_of(given_, SHAPE)), seen(Probabilities(softmax, channels="last")))


def test_pixels_without_a_class_have_no_map():
    (images,) = Labels(VOC, ignore=255).layers(SHAPE)
    assert images.labels == ("0", "7")
    (images,) = Labels(VOC).layers(SHAPE)
    assert images.labels == ("0", "7", "255")
    (images,) = kind_of(VOC, SHAPE, {0: "background", 7: "car"}).layers(SHAPE)
    assert images.labels == ("background", "car")
    (images,) = kind_of(VOC, SHAPE, {0: "background", 7: "car", 255: "border"}).layers(SHAPE)
    assert images.labels == ("background", "car", "border")


@pytest.mark.parametrize(
    ("array", "kind"),
    [
        (MASK, Masks),
        (STACK, Masks),
        (STACK.astype(np.uint8), Masks),
        (STACK.astype(np.uint8) * 255, Masks),
        (CLASSES, Labels),
        (CLASSES.astype(np.uint8), Labels),
        (torch.from_numpy(CLASSES), Labels),
        (np.where(MASK, 7, 0), Labels),
        (np.where(MASK, 1, -1), Labels),
        (np.where(MASK, 300, 255), Labels),
        (MASK * 0.7, Probabilities),
        (MASK.astype(np.float16), Probabilities),
    ],
)
def test_an_unambiguous_array_has_that_kind(array, kind):
    found = kind_of(array, SHAPE)
    assert type(found) is kind
    np.testing.assert_array_equal(seen(found), seen(kind(array)))


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (MASK.astype(int), r"a mask or a label map in integers from 0 to 1: use Masks\(array\), or Labels\(array\)"),
        (MASK.astype(np.uint8) * 255, r"a mask or a label map in integers from 0 to 255"),
        (np.zeros(SHAPE, np.uint8), "a mask or a label map"),
        (np.full(SHAPE, 255, np.uint8), "a mask or a label map"),
        (np.where(MASK, 252, 2).astype(np.uint8), "a mask or a label map"),
        (VOC, r"use Labels\(array, ignore=255\), or Labels\(array\)"),
        (np.zeros((*SHAPE, 2), np.float32), r"found flow or probabilities in .*Flow\.of\(array\)"),
        (np.zeros((*SHAPE, 3), np.uint8), r"found a colour image or 3 images in"),
        (np.zeros((*SHAPE, 4), bool), r"use Masks\(array, channels='last'\) for 4 images"),
        (np.zeros((*SHAPE, 3)), r"use Probabilities\(array, channels='last'\)"),
        (Image.new("L", (30, 20)), r"found an image file: use Masks\.read"),
        ([Image.new("1", (30, 20))] * 2, r"found an image file: use Masks\.read"),
        ("mask.png", r"found an image file: use Masks\.read"),
        (np.ma.masked_less(CLASSES, 2), "found one with masked values"),
    ],
)
def test_an_ambiguous_array_is_refused_with_the_possible_kinds(array, message):
    with pytest.raises(InputError, match=f"^modality: .*{message}"):
        kind_of(array, SHAPE)


def test_names_decide_between_a_mask_and_labels():
    (images,) = kind_of(MASK.astype(int), SHAPE, ["floor", "chair"]).layers(SHAPE)
    assert images.labels == ("floor", "chair")
    with pytest.raises(InputError, match="a mask or a label map"):
        kind_of(MASK.astype(int), SHAPE, ["chair"])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: kind_of(np.zeros((3, 4), bool), (2, 3)), r"expected \(2, 3\) or \(K, 2, 3\) of bool, found \(3, 4\)"),
        (lambda: kind_of(np.zeros((0, 2, 3), bool), (2, 3)), r"found \(0, 2, 3\)"),
        (lambda: kind_of(np.full((2, 2, 3), 5), (2, 3)), r"a stack of masks has to be bool"),
        (lambda: kind_of(np.full((2, 3), -1), (2, 3)), r"expected 1 to 256 labels from 0 up, found 0"),
        (lambda: kind_of(np.full((2, 3), np.nan), (2, 3)), r"found NaN or infinity"),
        (lambda: kind_of(np.full((2, 3), 1.5), (2, 3)), r"expected values in \[0, 1\], found 1.5 to 1.5"),
        (lambda: kind_of(np.array([["a"] * 3] * 2), (2, 3)), r"expected an array of bool, integers or .*, found <U1"),
        (lambda: kind_of(None, (2, 3)), r"found object"),
        (
            lambda: kind_of(np.zeros((3, 2), bool), (2, 3)),
            r"rows and columns are swapped, or only the phot",
        ),
        (lambda: Masks(CLASSES), r"found 6 grey levels from 0 to 5; is it a label map\?"),
        (lambda: Masks(np.where(MASK, 1.0, 0.3)), r"found 2 grey levels from 0.3 to 1"),
        (lambda: Masks(np.zeros((*SHAPE, 3), np.uint8)), r"take one channel of a colour image"),
        (lambda: Labels(MASK * 0.5), r"expected integers \(20, 30\), found float64 \(20, 30\)"),
        (lambda: Probabilities(CLASSES), r"expected probabilities in floating point, found int64"),
    ],
)
def test_invalid_values_of_a_kind_are_refused(make, message):
    with pytest.raises(InputError, match=f"^modality: .*{message}"):
        kind = make()
        kind.layers(SHAPE if np.shape(kind.values)[0] == SHAPE[0] else (2, 3))


def test_a_label_without_a_name_is_refused():
    with pytest.raises(InputError, match=r"names: .*KeyError\(5\)"):
        Labels(np.full((2, 3), 5), {0: "wall"}).layers((2, 3))


@given(st.integers(0, 2**32 - 1), st.sampled_from(["i1", "u1", "i2", "u2", "i8"]))
def test_a_label_map_is_complete_in_its_images(seed, dtype):
    rng = np.random.default_rng(seed)
    array = rng.choice([0, 1, 2, 3, 40, 100, 127], SHAPE).astype(dtype)
    (images,) = kind_of(array, SHAPE).layers(SHAPE)
    np.testing.assert_array_equal(np.sum([int(k) * image for k, image in zip(images.labels, images.images)], 0), array)
