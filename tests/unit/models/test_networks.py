"""Parts of networks, and Zero-BEV: shapes, independence, shared parts, attention, checkpoints."""

import json
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file, save_file

from zerobev.common.errors import InputError
from zerobev.config import SCALES, CameraConfig
from zerobev.models import ZeroBEV
from zerobev.models.backbone import RgbEncoder, ZeroCNN
from zerobev.models.band_transformer import BandTransformer
from zerobev.models.decoder import BevDecoder
from zerobev.models.polar import band_rows, floor_row
from zerobev.models.pyramid import FeaturePyramid
from zerobev.models.variants import build

SMOKE = SCALES["smoke"]


@pytest.fixture(autouse=True)
def seeded():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def network(camera=SMOKE.camera, **changes) -> ZeroBEV:
    """A network of the smoke scale in evaluation mode, with batch-norm statistics other than 0 and 1."""
    net = ZeroBEV(camera, replace(SMOKE.model, **changes)).eval()
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.uniform_(-0.2, 0.2)
            module.running_var.uniform_(0.5, 2.0)
    return net


def images(batch: int, k: int, side: int = 32) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.rand(batch, 3, side, side), (torch.rand(batch, k, side, side) > 0.7).float()


@pytest.mark.parametrize("side", [32, 50, 61, 96])
@pytest.mark.parametrize("stem", [2, 4])
def test_both_extractors_have_the_same_strides(side, stem):
    model = replace(SMOKE.model, stem_stride=stem)
    rgb_maps = RgbEncoder(model).eval()(torch.rand(1, 3, side, side))
    zero_maps = ZeroCNN(model.zero_channels, stem)(torch.rand(1, 1, side, side))
    expected = [-(-side // (stem * 2**b)) for b in range(4)]
    assert [m.shape[-1] for m in rgb_maps] == [m.shape[-1] for m in zero_maps] == expected
    assert [m.shape[1] for m in rgb_maps] == list(model.channels)


@pytest.mark.parametrize("stem", [2, 4])
def test_no_pixel_of_the_zero_image_is_lost(stem):
    zero = torch.rand(1, 1, 33, 33, requires_grad=True)
    ZeroCNN((8, 8, 16, 16), stem)(zero)[0].square().sum().backward()
    assert (zero.grad != 0).all()


def test_pyramid_keeps_odd_sizes_and_aligns_coarse_and_fine_pixels():
    pyramid = FeaturePyramid((3, 3, 3, 3), 5)
    sizes = (25, 13, 7, 4)
    maps = [torch.rand(2, 3, n, n) for n in sizes]
    before = pyramid(maps)
    assert [m.shape for m in before] == [(2, 5, n, n) for n in sizes]
    maps[1] = maps[1].clone()
    maps[1][..., 9, 6] += 1
    changed = (pyramid(maps)[0] - before[0]).abs().sum((0, 1)).nonzero()
    assert changed.min(0).values.tolist() == [17, 11] and changed.max(0).values.tolist() == [20, 14]


@torch.no_grad()
def test_laterals_of_two_images_add_up_to_those_of_their_concatenated_features():
    """So the RGB image's part serves all its zero-shot images."""
    net, (rgb, zero) = network(), images(2, 3)
    expected = [
        net.pyramid([torch.cat(pair, dim=1) for pair in zip(net.backbone(rgb), net.zero_cnn(zero[:, k : k + 1]))])
        for k in range(3)
    ]
    shared = net.fpv_maps(net.rgb_laterals(rgb), zero)
    for maps, apart in zip(shared, zip(*expected)):
        assert torch.allclose(maps.unflatten(0, (2, 3)), torch.stack(apart, dim=1), atol=1e-5)


def test_columns_are_independent_and_attention_is_a_distribution():
    band = BandTransformer(16, 4, 32, 2, 0.0, rows=9, positions=5)
    columns = torch.randn(12, 9, 16)
    rays, attention = band(columns)
    order = torch.randperm(12)
    assert torch.allclose(band(columns[order])[0], rays[order], atol=1e-5)
    assert [w.shape for w in attention.cross] == [(12, 4, 5, 9)] * 2
    assert [w.shape for w in attention.rays] == [(1, 4, 5, 5), (12, 4, 5, 5)]
    for weights in (*attention.columns, *attention.rays, *attention.cross):
        assert torch.allclose(weights.sum(-1), torch.ones(()), atol=1e-5) and (weights >= 0).all()


class Placed(torch.nn.Module):
    """torch's own attention with positions added to queries and keys by hand."""

    def __init__(self, ours, position, memory_position):
        super().__init__()
        self.attention = torch.nn.MultiheadAttention(16, 4, batch_first=True)
        self.attention.in_proj_weight.data, self.attention.in_proj_bias.data = ours.inputs.weight, ours.inputs.bias
        self.attention.out_proj.load_state_dict(ours.out.state_dict())
        self.positions = position, memory_position

    def forward(self, x, memory):
        return self.attention(x + self.positions[0], memory + self.positions[1], memory)[0]


@torch.no_grad()
def test_band_transformer_equals_the_library_attention_with_positions_on_queries_and_keys():
    """Encoder and decoder, two layers each, written out with torch's own attention, post-norm."""
    band = BandTransformer(16, 4, 32, 2, 0.0, rows=9, positions=5).eval()
    for parameter in band.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    p, q = band.position, band.ray_position
    columns = torch.randn(6, 9, 16)
    x = columns
    for layer in band.encoder:
        x = layer.norms[0](x + Placed(layer.attention, p, p)(x, x))
        x = layer.norms[1](x + layer.feed_forward(x))
    y = band.ray.expand(6, -1, -1)
    for layer in band.decoder:
        y = layer.norms[0](y + Placed(layer.self_attention, q, q)(y, y))
        y = layer.norms[1](y + Placed(layer.cross_attention, q, p)(y, x))
        y = layer.norms[2](y + layer.feed_forward(y))
    assert torch.allclose(band(columns)[0], y, atol=1e-5)


def test_ray_positions_start_from_their_own_embedding():
    band = BandTransformer(16, 4, 32, 2, 0.0, rows=9, positions=5)
    band(torch.randn(3, 9, 16))[0].square().sum().backward()
    assert (band.ray.grad.abs().sum(1) > 0).all()
    assert len(band.ray.grad.unique(dim=0)) == 5


@pytest.mark.parametrize("size", [20, 25, 33, 100])
def test_decoder_keeps_every_size(size):
    assert BevDecoder(16, (8, 8, 8), 3)(torch.rand(2, 16, size, size)).shape == (2, 3, size, size)


def test_maps_of_one_image_stay_channels_last():
    """In another layout they would be copied in every following convolution."""
    net = build("c", SMOKE.camera, SMOKE.model)
    laterals = net.rgb_laterals(torch.rand(2, 3, 32, 32))
    maps = net.fpv_maps(laterals, torch.rand(2, 1, 32, 32))
    assert all(m.is_contiguous(memory_format=torch.channels_last) for m in (*laterals, *maps))


def test_map_features_are_zero_outside_the_view():
    net = network()
    features, _ = net.bands(net.fpv_maps(net.rgb_laterals(torch.rand(2, 3, 32, 32)), torch.rand(2, 1, 32, 32)))
    assert torch.equal((features != 0).any(1).all(0), net.bands.valid)


@torch.no_grad()
def test_a_column_of_the_image_affects_only_its_rays():
    """In the far band, a change to one column of the finest map changes only cells within its view."""
    net = network()
    maps = net.fpv_maps(net.rgb_laterals(torch.rand(1, 3, 32, 32)), torch.rand(1, 1, 32, 32))
    before, _ = net.bands(maps)
    maps[0] = maps[0].clone()
    maps[0][..., 11] += torch.randn(16, 16)
    changed = (net.bands(maps)[0] != before).any(1)[0]  # M M
    far = net.bands.resamplers[-1]
    expected = torch.zeros(20, 20, dtype=torch.bool)
    expected[: len(far.weights)] = far.weights[..., 11] > 0
    assert torch.equal(changed, expected)


@torch.no_grad()
def test_cross_attention_of_any_column_and_position():
    net, (rgb, zero) = network(), images(2, 1)
    near, *_, far = net.attention(rgb, zero)
    assert far.cross[-1].unflatten(0, (2, -1)).shape == (2, 16, 4, 5, 16)
    assert near.cross[-1].unflatten(0, (2, -1)).shape == (2, 2, 4, 3, 2)
    alone = net.attention(rgb[1:], zero[1:])[-1].cross[-1]
    assert torch.allclose(alone, far.cross[-1].unflatten(0, (2, -1))[1], atol=1e-5)


def broken(path, how):
    """Make the checkpoint at `path` unusable in one way."""
    described = json.dumps({"class": "ZeroBEV", "camera": {"fpv_px": 32, "bev_px": 20}, "model": {}})
    tensors = load_file(path)
    if how == "absent":
        path.unlink()
    elif how == "text":
        path.write_text("not a checkpoint")
    elif how == "no metadata":
        save_file(tensors, path)
    elif how == "no widths":
        save_file(tensors, path, metadata={"zerobev": described})
    else:
        with path.open("rb") as file:
            header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
        metadata = header["__metadata__"]
        if how == "missing weight":
            tensors.pop("decoder.head.bias")
        elif how == "foreign weight":
            tensors["other"] = torch.zeros(1)
        elif how == "other shape":
            tensors["decoder.head.bias"] = torch.zeros(7)
        elif how == "other class":
            metadata = {"zerobev": metadata["zerobev"].replace("ZeroBEV", "Other")}
        save_file(tensors, path, metadata=metadata)


@pytest.mark.parametrize(
    "how",
    [
        *("absent", "text", "no metadata", "no widths"),
        *("missing weight", "foreign weight", "other shape", "other class"),
    ],
)
def test_unusable_checkpoints_are_named(tmp_path, how):
    path = tmp_path / "weights.safetensors"
    network().save(path)
    broken(path, how)
    with pytest.raises(InputError) as caught:
        ZeroBEV.load(path)
    assert str(path) in str(caught.value) and "expected" in str(caught.value) and "\n" not in str(caught.value)


def test_only_a_ground_start_attends_to_the_floor():
    """Before training, each position of a ray attends to the image row of the floor at its depth."""
    camera = CameraConfig(fpv_px=64, bev_px=40)
    images = torch.rand(2, 3, 64, 64), (torch.rand(2, 1, 64, 64) > 0.8).float()
    errors = {}
    for start in (True, False):
        torch.manual_seed(0)
        model = replace(SCALES["reduced"].model, ground_start=start)
        net = build("c", camera, model).eval()
        with torch.inference_mode():
            far = net.attention(*images)[-1].cross[0][:, 0]  # first head, of the highest frequencies: N P R
        expected = floor_row(camera, band_rows(camera, model.band_edges_m)[-1], model.stem_stride)
        errors[start] = (far.argmax(-1) - expected).abs().mean()
    assert errors[True] < 0.6 and errors[False] > 3


def test_residual_gain_scales_the_added_projection():
    """The change of the map features by the projection is proportional to the gain."""
    zero, depth = torch.ones(1, 1, 32, 32), torch.full((1, 1, 32, 32), 2.0)
    moved = []
    for gain in (1.0, 6.0):
        torch.manual_seed(0)
        net = build("d", SCALES["smoke"].camera, replace(SCALES["smoke"].model, residual_init_gain=gain)).eval()
        seen = []
        net.decoder.register_forward_pre_hook(lambda module, features, seen=seen: seen.append(features[0]))
        with torch.inference_mode():
            for planes in (depth, torch.zeros_like(depth)):  # depth 0: no pixel has a cell
                net(torch.zeros(1, 3, 32, 32), zero, planes)
        moved.append(seen[0] - seen[1])
    assert moved[0].abs().max() > 0.1
    torch.testing.assert_close(moved[1], 6 * moved[0], atol=1e-5, rtol=1e-4)


def test_zero_gain_scales_every_map_of_the_zero_cnn():
    image = torch.rand(2, 1, 32, 32)
    maps = []
    for gain in (1.0, 5.0):
        torch.manual_seed(0)
        maps.append(ZeroCNN((4, 8, 8, 8), 2, gain=gain)(image))
    for plain, scaled in zip(*maps):
        torch.testing.assert_close(scaled, 5 * plain)
