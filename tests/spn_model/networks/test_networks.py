"""Tests of pose regressors: layers of the papers, torchvision names, and preserved pretrained features."""

from __future__ import annotations

import math
import re

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from spn_data.errors import InputError
from spn_model.networks.imagenet import MEAN, STD
from spn_model.networks.normalization import InsertedBatchNorm, initialize_as_identity
from spn_model.networks.posenet import PoseNet
from spn_model.networks.registry import REGRESSORS, build, options_of
from spn_model.networks.squeezeposenet import SqueezePoseNetOptions
from spn_model.pretrained.tensors import load_pretrained, read_tensors
from spn_model.pretrained.weights import find

torch.set_num_threads(1)
MIB = 2**20


@pytest.fixture(scope="module")
def vgg16():
    return build("vgg16").eval()


@pytest.fixture
def posenet():
    return build("posenet")


def photos(count: int = 6, height: int = 64, width: int = 96) -> torch.Tensor:
    """Return smooth random images, shape (B, 3, H, W), normalised for the networks."""
    drawn = torch.rand((count, 3, height // 8, width // 8), generator=torch.manual_seed(5))
    values = F.interpolate(drawn, size=(height, width), mode="bicubic").clamp(0, 1)
    return (values - torch.tensor(MEAN)[:, None, None]) / torch.tensor(STD)[:, None, None]


def pretrained_squeezeposenet(**options):
    network = build("squeezeposenet", options)
    path = find(network.weights_name)
    load_pretrained(network, read_tensors(path), path)
    return network


def count(*modules: nn.Module, without: type[nn.Module] | None = None) -> int:
    """Return the number of parameters of modules, excluding one type of layer."""
    return sum(
        parameter.numel()
        for module in modules
        for layer in module.modules()
        if without is None or not isinstance(layer, without)
        for parameter in layer.parameters(recurse=False)
    )


# torchvision documents 1,248,424, 1,235,496, 138,357,544 and 6,624,904 parameters with 1000 classes.


@pytest.mark.parametrize(("version", "published"), [("1.0", 1_248_424), ("1.1", 1_235_496)])
def test_squeezenet_has_the_published_number_of_parameters(version, published):
    """With conv10 and without inserted normalisation layers, the trunk has SqueezeNet's parameter count."""
    network = build("squeezeposenet", {"version": version, "conv10": True})
    trunk = count(network.features, network.classifier, without=InsertedBatchNorm)
    assert trunk == published


def test_the_papers_size_of_squeezenet_is_that_of_version_1_0():
    """The 4.8 MB of section 3 match version 1.0 in float32; version 1.1 has 4.7 MB."""
    assert f"{1_248_424 * 4 / MIB:.1f} {1_235_496 * 4 / MIB:.1f}" == "4.8 4.7"


def test_squeezeposenet_fits_on_board():
    """fc11 has 500 neurons, x has 3 and q has 4; all weights take 4.0 MB, less than 5 MB."""
    network = build("squeezeposenet")
    assert [tuple(layer.weight.shape) for layer in (network.fc11, network.x, network.q)] == [
        (500, 512),
        (3, 500),
        (4, 500),
    ]
    inserted = 2 * (64 + 2 * sum(s + 2 * e for s, e in ((16, 64), (32, 128), (48, 192), (64, 256))))
    assert count(network) == 1_235_496 - 513_000 + inserted + 512 * 500 + 500 + 7 * 501 == 988_391
    assert count(network) * 4 < 5e6


def test_vgg16_has_the_papers_size(vgg16):
    """With its classifier in place of the heads it has 138,357,544 parameters, the paper's 528 MB."""
    with_classes = count(vgg16) - count(vgg16.x, vgg16.q) + 4096 * 1000 + 1000
    assert with_classes == 138_357_544
    assert round(with_classes * 4 / MIB) == 528


def test_posenet_has_the_papers_size(posenet):
    """GoogLeNet as published, with 2048 neurons and three regressors, takes about 50 MB."""
    heads = count(posenet.fc1, posenet.x, posenet.q, posenet.aux1, posenet.aux2)
    assert count(posenet) - heads + 1024 * 1000 + 1000 == 6_624_904
    assert tuple(posenet.fc1.weight.shape) == (2048, 1024)
    assert 45e6 < count(posenet) * 4 < 52e6


def test_every_relu_of_squeezenet_and_vgg16_is_leaky(vgg16):
    """All activations are leaky ReLUs with the slope of the options, as in the paper."""
    squeeze = build("squeezeposenet", {"slope": 0.02})
    for network, slope, expected in ((squeeze, 0.02, 1 + 3 * 8 + 1), (vgg16, 0.01, 13 + 2)):
        leaky = [layer for layer in network.modules() if isinstance(layer, nn.LeakyReLU)]
        assert [layer.negative_slope for layer in leaky] == [slope] * expected
        assert not [layer for layer in network.modules() if isinstance(layer, nn.ReLU)]


@pytest.mark.parametrize("version", ["1.0", "1.1"])
def test_each_convolution_of_squeezeposenet_is_normalised(version):
    """Each convolution is followed by batch normalisation of its channels, before its activation."""
    network = build("squeezeposenet", {"version": version, "conv10": True})
    layers = dict(network.named_modules())
    convolutions = [n for n, layer in layers.items() if isinstance(layer, nn.Conv2d)]
    assert len(convolutions) == 26
    for name in convolutions:
        slot = f"{name}_activation" if "squeeze" in name or "expand" in name else None
        if slot is None:
            stem, _, index = name.rpartition(".")
            slot = f"{stem}.{int(index) + 1}"
        assert isinstance(layers[f"{slot}.0"], InsertedBatchNorm), name
        assert layers[f"{slot}.0"].num_features == layers[name].out_channels
        assert isinstance(layers[f"{slot}.1"], nn.LeakyReLU)


def test_parameters_of_vgg16_have_torchvisions_names(vgg16):
    """The thirteen convolutions and two dense layers have torchvision's names."""
    wanted = [f"features.{k}" for k in (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)]
    wanted += ["classifier.0", "classifier.3"]
    names = [n for n, _ in vgg16.named_parameters() if n[:2] not in ("x.", "q.")]
    assert names == [f"{layer}.{kind}" for layer in wanted for kind in ("weight", "bias")]
    assert tuple(vgg16.classifier[0].weight.shape) == (4096, 25088)


def test_parameters_of_posenet_have_torchvisions_names(posenet):
    """The stem and nine inception blocks of six normalised convolutions have torchvision's names."""
    blocks = [f"inception{k}" for k in ("3a", "3b", "4a", "4b", "4c", "4d", "4e", "5a", "5b")]
    inner = ("branch1", "branch2.0", "branch2.1", "branch3.0", "branch3.1", "branch4.1")
    wanted = ["conv1", "conv2", "conv3", *(f"{b}.{i}" for b in blocks for i in inner)]
    kinds = ("conv.weight", "bn.weight", "bn.bias")
    names = [n for n, _ in posenet.named_parameters() if re.match("conv|inception", n)]
    assert names == [f"{layer}.{kind}" for layer in wanted for kind in kinds]
    shape = posenet.inception3a.branch3[1].conv.weight.shape
    assert tuple(shape) == (32, 16, 3, 3)  # torchvision's 3 x 3, not the paper's 5 x 5


def reference_squeezenet1_1(weights: dict[str, torch.Tensor], images: torch.Tensor) -> torch.Tensor:
    """Compute features of SqueezeNet 1.1, implemented independently from the authors' table."""

    def convolved(name: str, maps: torch.Tensor, **how: int) -> torch.Tensor:
        return F.relu(F.conv2d(maps, weights[f"{name}.weight"], weights[f"{name}.bias"], **how))

    maps = convolved("features.0", images, stride=2)
    for k in range(2, 13):
        if k in (2, 5, 8):
            maps = F.max_pool2d(maps, 3, 2, ceil_mode=True)
            continue
        squeezed = convolved(f"features.{k}.squeeze", maps)
        narrow = convolved(f"features.{k}.expand1x1", squeezed)
        wide = convolved(f"features.{k}.expand3x3", squeezed, padding=1)
        maps = torch.cat([narrow, wide], 1)
    return maps


@torch.no_grad()
def test_with_slope_zero_the_trunk_computes_what_squeezenet_does():
    """Pretrained features equal those of plain SqueezeNet 1.1, for odd image sizes too."""
    network = pretrained_squeezeposenet(slope=0.0).eval()
    images = photos(2, 135, 240)
    weights = {name: t.float() for name, t in read_tensors(find(network.weights_name)).items()}
    initialize_as_identity(network, [images])
    expected = reference_squeezenet1_1(weights, images)
    assert float(expected.std()) > 0.1
    torch.testing.assert_close(network.features(images), expected, rtol=1e-3, atol=2e-3)
    torch.testing.assert_close(
        network.trunk(images)[0], expected.mean((2, 3)), rtol=1e-3, atol=1e-3
    )


@torch.no_grad()
def test_inserted_normalisation_starts_as_the_identity():
    """Initialised normalisation layers do not change outputs, also for images not used to measure them."""
    network = pretrained_squeezeposenet().eval()
    without = pretrained_squeezeposenet().eval()
    for name, layer in list(without.named_modules()):
        if isinstance(layer, InsertedBatchNorm):
            parent, _, slot = name.rpartition(".")
            setattr(without.get_submodule(parent), slot, nn.Identity())
    images, others = photos(6), photos(8)[6:]
    initialize_as_identity(network, [images])
    for seen in (images, others):
        expected = without.trunk(seen)[0]
        assert float(expected.abs().max()) > 0.5
        torch.testing.assert_close(network.trunk(seen)[0], expected, rtol=1e-4, atol=1e-4)
        for ours, theirs in zip(network(seen), without(seen), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_normalisation_is_measured_not_left_at_its_defaults():
    """Weight is sqrt(var + eps) and bias the mean of the layer's input, over all batches."""
    network = pretrained_squeezeposenet().eval()
    images = photos(6)
    initialize_as_identity(network, [images[:1], images[1:3], images[3:]])
    first = network.features[0](images).double()
    layer = network.features[1][0]
    mean, variance = first.mean((0, 2, 3)), first.var((0, 2, 3), unbiased=False)
    torch.testing.assert_close(layer.running_mean.double(), mean, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(layer.running_var.double(), variance, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(layer.bias, layer.running_mean)
    torch.testing.assert_close(layer.weight, (layer.running_var + layer.eps).sqrt())


@torch.no_grad()
def test_what_a_normalisation_was_before_does_not_matter():
    """Initialising a second time, on other images, gives the same result as doing so only once."""
    network, fresh = pretrained_squeezeposenet(), pretrained_squeezeposenet()
    initialize_as_identity(network, [photos(2) * 3 + 1])
    for layer in network.modules():
        if isinstance(layer, InsertedBatchNorm):
            layer.weight.mul_(2)
    for measured in (network, fresh):
        initialize_as_identity(measured, [photos(4)])
    for name, tensor in fresh.state_dict().items():
        torch.testing.assert_close(network.state_dict()[name], tensor)


@torch.no_grad()
def test_a_channel_that_never_varied_still_lets_other_values_through():
    """A constant channel, such as a dead ReLU, still passes other values unchanged."""
    network = nn.Sequential(InsertedBatchNorm(2)).eval()
    still = torch.stack([torch.full((4, 4), 3.0), torch.zeros(4, 4)])[None]
    initialize_as_identity(network, [still])
    other = torch.randn(5, 2, 4, 4, generator=torch.manual_seed(3))
    torch.testing.assert_close(network(other), other, rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_training_mode_starts_where_eval_mode_is():
    """On the measured batch, training mode gives the same features as evaluation mode."""
    network = pretrained_squeezeposenet(dropout=0.0).eval()
    images = photos(6)
    initialize_as_identity(network, [images])
    evaluated = network.trunk(images)[0]
    trained = network.train().trunk(images)[0]
    torch.testing.assert_close(trained, evaluated, rtol=1e-3, atol=1e-3)


def test_the_identity_start_keeps_mode_and_other_normalisations(posenet):
    """GoogLeNet's pretrained normalisation layers and the training mode are unchanged."""
    before = {name: tensor.clone() for name, tensor in posenet.state_dict().items()}
    initialize_as_identity(posenet, [photos(2)])
    assert all(torch.equal(before[name], tensor) for name, tensor in posenet.state_dict().items())
    network = build("squeezeposenet").train()
    initialize_as_identity(network, [photos(2)])
    assert network.training
    assert network.features.training


@pytest.mark.parametrize("images", [[], [torch.full((1, 3, 64, 64), math.nan)]])
def test_the_identity_start_needs_images(images):
    """Without images, or with NaN in them, ValueError is raised and nothing is changed."""
    network = build("squeezeposenet")
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    with pytest.raises(ValueError, match=r"no images|not finite"):
        initialize_as_identity(network, images)
    assert all(torch.equal(before[name], tensor) for name, tensor in network.state_dict().items())


@torch.no_grad()
@pytest.mark.parametrize(("height", "width"), [(224, 224), (135, 240), (101, 67)])
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("squeezeposenet", {}),
        ("squeezeposenet", {"version": "1.0"}),
        ("squeezeposenet", {"conv10": True}),
        ("posenet", {}),
    ],
)
def test_a_network_takes_images_of_any_size(name, options, height, width):
    """x has shape (B, 3), q has shape (B, 4), and both depend on the image."""
    network = build(name, options).eval()
    x, q = network(photos(2, height, width)[:, :, :height, :width])
    assert (x.shape, q.shape) == ((2, 3), (2, 4))
    assert not torch.allclose(x[0], x[1])
    assert not torch.allclose(q[0], q[1])


@torch.no_grad()
def test_vgg16_takes_images_of_any_size(vgg16):
    """VGG16 also accepts any image size, with outputs that depend on the image."""
    for height, width in ((64, 96), (33, 70)):
        x, q = vgg16(torch.randn(2, 3, height, width, generator=torch.manual_seed(1)))
        assert (x.shape, q.shape) == ((2, 3), (2, 4))
        assert not torch.allclose(x[0], x[1])


@torch.no_grad()
@pytest.mark.parametrize("name", list(REGRESSORS))
def test_the_smallest_side_is_enough(name, vgg16):
    """Images of min_side_px are large enough for all pooling layers, whatever the options."""
    variants = [{"version": "1.0"}, {"version": "1.1"}] if name == "squeezeposenet" else [{}]
    for options in variants:
        network = vgg16 if name == "vgg16" else build(name, options).eval()
        x, _ = network(torch.zeros(1, 3, network.min_side_px, network.min_side_px))
        assert x.shape == (1, 3)


@torch.no_grad()
def test_a_leaky_relu_follows_fc11():
    """A leaky ReLU follows fc11; otherwise fc11 and the heads would form one linear map."""
    network = build("squeezeposenet").eval()
    features = torch.randn(1, 512, generator=torch.manual_seed(4))
    descriptor = F.leaky_relu(features @ network.fc11.weight.T + network.fc11.bias, 0.01)
    x, q = network.regress((features,))[0]
    expected = descriptor @ network.x.weight.T + network.x.bias
    torch.testing.assert_close(x, expected, rtol=1e-4, atol=1e-5)
    assert q.shape == (1, 4)


@torch.no_grad()
@pytest.mark.parametrize("name", ["squeezeposenet", "vgg16"])
def test_signals_last_through_an_untrained_network(name, vgg16):
    """He initialisation keeps features between 0.01 and 100 times the scale of the input."""
    network = vgg16 if name == "vgg16" else build(name).eval()
    images = torch.randn(2, 3, 64, 64, generator=torch.manual_seed(2))
    assert 0.01 < float(network.trunk(images)[0].std()) < 100


def test_posenet_has_three_estimates_in_training_and_one_in_use(posenet):
    """Auxiliary heads are used in training only, with weights of 0.3.

    Their gradients reach the trunk.
    """
    images = photos(2)
    estimates = posenet.train().estimates(images)
    assert len(estimates) == len(posenet.estimate_weights) == 3
    assert posenet.estimate_weights == (1.0, 0.3, 0.3)
    for x, q in estimates:
        assert (x.shape, q.shape) == ((2, 3), (2, 4))
    estimates[1][0].sum().backward()
    assert posenet.conv1.conv.weight.grad.abs().sum() > 0
    assert posenet.inception5b.branch1.conv.weight.grad is None
    assert len(posenet.eval().estimates(images)) == 1


@torch.no_grad()
def test_posenet_rescales_images_as_its_weights_expect(posenet):
    """Values 0, 0.5 and 1 of each channel reach the first convolution as -1, 0 and 1."""
    values = torch.tensor([0.0, 0.5, 1.0])[:, None, None, None].expand(3, 3, 32, 32)
    images = (values - torch.tensor(MEAN)[:, None, None]) / torch.tensor(STD)[:, None, None]
    seen = []
    posenet.conv1.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    posenet.eval()(images)
    torch.testing.assert_close(seen[0], 2 * values - 1, rtol=0, atol=1e-6)
    assert not [name for name in posenet.state_dict() if "scale" in name or "shift" in name]


@pytest.mark.parametrize(
    ("name", "added"),
    [
        ("squeezeposenet", {"fc11", "x", "q"}),
        ("vgg16", {"x", "q"}),
        ("posenet", {"fc1", "x", "q", "aux1", "aux2"}),
    ],
)
def test_groups_of_parameters_are_those_of_the_papers_stages(name, added, vgg16):
    """Each parameter is in exactly one of two groups, the added or the pretrained layers."""
    network = vgg16 if name == "vgg16" else build(name)
    groups = network.parameter_groups()
    names = {id(parameter): n for n, parameter in network.named_parameters()}
    assert {names[id(p)].split(".")[0] for p in groups["added"]} == added
    assert sorted(map(id, groups["added"] + groups["pretrained"])) == sorted(names)


def test_a_frozen_trunk_does_not_move():
    """A training step of the added layers changes neither weights nor running statistics of the trunk."""
    network = build("squeezeposenet")
    network.freeze_trunk()
    network.train()
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    optimiser = torch.optim.SGD([p for p in network.parameters() if p.requires_grad], lr=0.1)
    x, q = network(photos(4))
    (x.sum() + q.sum()).backward()
    optimiser.step()
    moved = {n for n, tensor in network.state_dict().items() if not torch.equal(before[n], tensor)}
    assert {name.split(".")[0] for name in moved} == {"fc11", "x", "q"}
    assert network.dropout.training
    network.freeze_trunk(False)
    assert network.features[1][0].training
    assert all(parameter.requires_grad for parameter in network.parameters())


def test_a_frozen_vgg16_drops_only_before_its_heads(vgg16):
    """A frozen trunk has no dropout, so that its features can be cached."""
    vgg16.train()
    vgg16.freeze_trunk()
    try:
        assert not vgg16.classifier[2].training
        assert vgg16.dropout.training
        assert vgg16.train().dropout.training
        assert not vgg16.classifier[2].training
    finally:
        vgg16.freeze_trunk(False)
        vgg16.eval()


@torch.no_grad()
@pytest.mark.parametrize("name", ["squeezeposenet", "posenet"])
def test_stored_features_give_the_same_pose(name):
    """regress(trunk(images)) equals the network's output, also if features come from single images."""
    network = build(name).eval()
    images = photos(3)
    x, q = network(images)
    stored = [network.trunk(images[k : k + 1]) for k in range(3)]
    again = network.regress(tuple(torch.cat(parts) for parts in zip(*stored, strict=True)))[0]
    torch.testing.assert_close(again[0], x, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(again[1], q, rtol=1e-4, atol=1e-5)


def test_a_seed_decides_the_weights_and_nothing_else():
    """Equal seeds give equal networks, other seeds differ, and torch's random state is unchanged."""
    state = torch.get_rng_state()
    first, again, other = (build("squeezeposenet", seed=seed) for seed in (3, 3, 4))
    assert torch.equal(torch.get_rng_state(), state)
    assert all(map(torch.equal, first.state_dict().values(), again.state_dict().values()))
    assert not torch.equal(first.fc11.weight, other.fc11.weight)


def test_options_make_the_same_kind_of_network_again():
    """The values of options_of rebuild a network with the same layers."""
    network = build("squeezeposenet", {"version": "1.0", "conv10": True, "slope": 0.1})
    assert options_of(network) == {
        "version": "1.0",
        "conv10": True,
        "slope": 0.1,
        "dropout": SqueezePoseNetOptions().dropout,
    }
    build("squeezeposenet", options_of(network)).load_state_dict(network.state_dict())


def test_whole_numbers_do_for_real_ones():
    """An integer is accepted for a float option, as in `dropout = 0` in TOML."""
    assert options_of(build("squeezeposenet", {"dropout": 0}))["dropout"] == 0.0


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("resnet", {}, "unknown network 'resnet'; choose one of squeezeposenet, vgg16, posenet"),
        (
            "vgg16",
            {"conv10": True},
            "network vgg16: unknown option 'conv10'; options are slope, dropout",
        ),
        ("squeezeposenet", {"conv10": 1}, "network squeezeposenet: conv10 is 1, needs a bool"),
        ("squeezeposenet", {"slope": True}, "slope is True, needs a float"),
        ("squeezeposenet", {"version": "1.2"}, "version is '1.2', needs to be 1.0 or 1.1"),
        (
            "squeezeposenet",
            {"dropout": 1.0},
            "network squeezeposenet: slope and dropout need to be in [0, 1)",
        ),
        ("squeezeposenet", {"slope": math.nan}, "slope is nan, needs a finite number"),
        (
            "posenet",
            {"auxiliary_dropout": -0.1},
            "dropout and auxiliary_dropout need to be in [0, 1)",
        ),
    ],
)
def test_what_cannot_be_built_is_told(name, options, message):
    """An invalid network or option gives a one-line error with what was asked and what is allowed."""
    with pytest.raises(InputError, match=re.escape(message)):
        build(name, options)


@torch.no_grad()
def test_dropout_can_be_turned_off():
    """With dropout rates of 0, training mode is deterministic, as the overfitting tests require."""
    network = PoseNet(type(build("posenet").options)(dropout=0.0, auxiliary_dropout=0.0)).train()
    images = photos(3)
    first, again = network.estimates(images), network.estimates(images)
    for (x, q), (x2, q2) in zip(first, again, strict=True):
        assert torch.equal(x, x2)
        assert torch.equal(q, q2)
