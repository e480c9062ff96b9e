"""The network: shapes, independence, sharing, checkpoints, size, and that it can learn."""

import json
import sys
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file, save_file

from zerobev.config import SCALES, CameraConfig
from zerobev.errors import InputError
from zerobev.models import ZeroBEV
from zerobev.models.__main__ import main, parameters
from zerobev.models.backbone import ZeroCNN, rgb_backbone
from zerobev.models.band_transformer import BandTransformer
from zerobev.models.decoder import BevDecoder
from zerobev.models.pyramid import FeaturePyramid

SMOKE = SCALES["smoke"]


@pytest.fixture(autouse=True)
def seeded():
    torch.set_num_threads(1)
    torch.manual_seed(0)


def network(camera=SMOKE.camera, **changes) -> ZeroBEV:
    """A network of the smoke scale in evaluation mode, its batch norms with statistics unlike 0 and 1."""
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
def test_both_extractors_meet_at_the_same_strides(side, stem):
    model = replace(SMOKE.model, stem_stride=stem)
    rgb_maps = rgb_backbone(model).eval()(torch.rand(1, 3, side, side)).feature_maps
    zero_maps = ZeroCNN(model.zero_channels, stem)(torch.rand(1, 1, side, side))
    expected = [-(-side // (stem * 2**b)) for b in range(4)]
    assert [m.shape[-1] for m in rgb_maps] == [m.shape[-1] for m in zero_maps] == expected
    assert [m.shape[1] for m in rgb_maps] == list(model.channels)


@pytest.mark.parametrize("stem", [2, 4])
def test_no_pixel_of_the_zero_image_is_lost(stem):
    zero = torch.rand(1, 1, 33, 33, requires_grad=True)
    ZeroCNN((8, 8, 16, 16), stem)(zero)[0].square().sum().backward()
    assert (zero.grad != 0).all()


def test_pyramid_keeps_odd_sizes_and_brings_the_coarse_pixel_over_its_fine_ones():
    pyramid = FeaturePyramid((3, 3, 3, 3), 5)
    sizes = (25, 13, 7, 4)
    maps = [torch.rand(2, 3, n, n) for n in sizes]
    before = pyramid(maps)
    assert [m.shape for m in before] == [(2, 5, n, n) for n in sizes]
    maps[1] = maps[1].clone()
    maps[1][..., 9, 6] += 1
    changed = (pyramid(maps)[0] - before[0]).abs().sum((0, 1)).nonzero()
    assert changed.min(0).values.tolist() == [17, 11] and changed.max(0).values.tolist() == [20, 14]


def test_columns_are_independent_and_attention_is_a_distribution():
    band = BandTransformer(16, 4, 32, 2, 0.0, rows=9, positions=5)
    columns = torch.randn(12, 9, 16)
    rays, attention = band.attend(columns)
    order = torch.randperm(12)
    assert torch.allclose(band(columns[order]), rays[order], atol=1e-5)
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
    assert torch.allclose(band(columns), y, atol=1e-5)


def test_ray_positions_start_from_their_own_embedding():
    band = BandTransformer(16, 4, 32, 2, 0.0, rows=9, positions=5)
    band(torch.randn(3, 9, 16)).square().sum().backward()
    assert (band.ray.grad.abs().sum(1) > 0).all()
    assert len(band.ray.grad.unique(dim=0)) == 5


@pytest.mark.parametrize("aux", [("obstacles", "navigable"), ("navigable",), ()])
def test_shapes_and_gradients_reach_every_parameter(aux):
    net = network(aux=aux).train()
    rgb, zero = images(2, 1)
    out = net(rgb, zero)
    assert out.zero_logits.shape == (2, 1, 20, 20)
    assert (out.aux_logits is None) if not aux else (out.aux_logits.shape == (2, len(aux), 20, 20))
    torch.cat([x.flatten() for x in out if x is not None]).square().sum().backward()
    dead = [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()]
    assert dead == []


@pytest.mark.parametrize(("fpv", "bev", "stem"), [(96, 25, 4), (50, 25, 2), (61, 33, 4)])
def test_odd_sizes(fpv, bev, stem):
    net = network(CameraConfig(fpv_px=fpv, bev_px=bev), stem_stride=stem)
    out = net(*images(2, 2, fpv))
    assert out.zero_logits.shape == (2, 2, bev, bev) and out.aux_logits.shape == (2, 2, bev, bev)
    assert net.bands.valid.shape == (bev, bev)


@pytest.mark.parametrize("size", [20, 25, 33, 100])
def test_decoder_gives_every_size_back(size):
    assert BevDecoder(16, (8, 8, 8), 3)(torch.rand(2, 16, size, size)).shape == (2, 3, size, size)


def test_map_features_are_zero_where_no_column_looks():
    net = network()
    features = net.bands(net.pyramid(net.fpv_maps(net.backbone(torch.rand(2, 3, 32, 32)), torch.rand(2, 1, 32, 32))))
    assert torch.equal((features != 0).any(1).all(0), net.bands.valid)


@torch.no_grad()
def test_a_batch_of_one_equals_a_batch_of_many():
    net, (rgb, zero) = network(), images(5, 1)
    together = net(rgb, zero)
    for i in range(5):
        alone = net(rgb[i : i + 1], zero[i : i + 1])
        assert torch.allclose(alone.zero_logits[0], together.zero_logits[i], atol=1e-5)
        assert torch.allclose(alone.aux_logits[0], together.aux_logits[i], atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("batch", [1, 3, 9])
def test_zero_images_share_the_photograph_and_nothing_else(batch):
    net, (rgb, zero) = network(), images(batch, 8)
    together = net(rgb, zero)
    passes = [net(rgb, zero[:, k : k + 1]) for k in range(8)]
    assert torch.allclose(together.zero_logits, torch.cat([p.zero_logits for p in passes], 1), atol=1e-5)
    assert torch.allclose(together.aux_logits, torch.stack([p.aux_logits for p in passes]).mean(0), atol=1e-5)
    order = torch.randperm(8)
    permuted = net(rgb, zero[:, order])
    assert torch.allclose(permuted.zero_logits, together.zero_logits[:, order], atol=1e-5)
    assert torch.allclose(permuted.aux_logits, together.aux_logits, atol=1e-5)


@torch.no_grad()
def test_the_photograph_passes_once(monkeypatch):
    net, calls = network(), []
    net.backbone.register_forward_hook(lambda *_: calls.append(1))
    net(*images(4, 8))
    assert len(calls) == 1


@torch.no_grad()
def test_a_column_of_the_image_reaches_only_its_rays():
    """Through the far band alone: change one column of the finest map, and only the cells it sees change."""
    net = network()
    maps = net.pyramid(net.fpv_maps(net.backbone(torch.rand(1, 3, 32, 32)), torch.rand(1, 1, 32, 32)))
    before = net.bands(maps)
    maps[0] = maps[0].clone()
    maps[0][..., 11] += torch.randn(16, 16)
    changed = (net.bands(maps) != before).any(1)[0]  # M M
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


@pytest.mark.parametrize("which", ["rgb", "zero", "batch", "dims"])
def test_inputs_of_the_wrong_shape_are_named(which):
    rgb, zero = images(2, 1)
    bad = {
        "rgb": (rgb[..., :30], zero, "rgb"),
        "zero": (rgb, zero[..., :30, :], "zero"),
        "batch": (rgb, zero[:1], "zero"),
        "dims": (rgb, zero[:, 0], "zero"),
    }[which]
    with pytest.raises(InputError, match=f"^{bad[2]}: expected"):
        network()(*bad[:2])


@torch.no_grad()
def test_save_and_load_give_identical_outputs_and_bytes(tmp_path):
    net, (rgb, zero) = network(aux=("navigable",)), images(2, 3)
    net.save(tmp_path / "a.safetensors")
    loaded = ZeroBEV.load(tmp_path / "a.safetensors")
    assert (loaded.camera, loaded.config) == (net.camera, net.config) and not loaded.training
    for ours, theirs in zip(loaded(rgb, zero), net(rgb, zero)):
        assert torch.equal(ours, theirs)
    loaded.to(memory_format=torch.channels_last).save(tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


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
        with open(path, "rb") as file:
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


def test_parameters_at_paper_scale():
    paper = SCALES["paper"]
    table = parameters(ZeroBEV(paper.camera, paper.model))
    assert table["total"] == pytest.approx(41e6, rel=0.03)
    assert table["decoder"] == pytest.approx(5.20e6, rel=0.002)
    assert table["bands"] == pytest.approx(8.97e6, rel=0.005)
    assert table["backbone"] == pytest.approx(23.5e6, rel=0.002)


def test_command_prints_and_writes_the_table(tmp_path, monkeypatch, capsys):
    file = tmp_path / "table.json"
    monkeypatch.setattr(sys, "argv", ["models", "--scale", "smoke", "--json", str(file)])
    main()
    written, printed = json.loads(file.read_text()), capsys.readouterr().out
    assert written["parameters"] == parameters(network())
    assert f"{written['parameters']['total']:,}" in printed and "41,000,000" in printed
    monkeypatch.setattr(sys, "argv", ["models", "--scale", "huge"])
    with pytest.raises(InputError, match="scale: expected"):
        main()


def test_it_learns_by_heart_and_only_through_the_zero_image():
    """Coarse random maps are learnt by heart; as the photograph is the same for all, only the zero images differ."""
    net = network().train()
    rgb, zero = images(1, 1)[0].expand(4, -1, -1, -1), images(4, 1)[1]
    target = (torch.rand(4, 3, 5, 5) > 0.6).float().repeat_interleave(4, 2).repeat_interleave(4, 3) * net.bands.valid
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-2)
    for _ in range(100):
        out = net(rgb, zero)
        p = torch.cat([out.zero_logits, out.aux_logits], 1).sigmoid() * net.bands.valid
        loss = 1 - 2 * (p * target).sum() / (p.sum() + target.sum())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < 0.15
