"""Tests of pretrained weights: the shipped file, other formats, hostile files, and downloads."""

from __future__ import annotations

import hashlib
import http.server
import re
import socket
import struct
import subprocess
import sys
import threading
import tomllib
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner
from safetensors.torch import save_file
from spn_cli.model import main

from spn_data.errors import InputError
from spn_model.networks.registry import build
from spn_model.pretrained.tensors import load_pretrained, read_tensors
from spn_model.pretrained.weights import (
    CATALOGUE,
    SHIPPED,
    by_name,
    cache_folder,
    fetch,
    find,
    state,
)

torch.set_num_threads(1)
ROOT = Path(__file__).resolve().parents[3]
FEATURES = by_name("squeezenet1_1-features")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    """Return an empty cache folder, so that the user's is never used."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return cache_folder()


@pytest.fixture(scope="module")
def original(shared_data) -> Path:
    """Return the path of the complete float32 SqueezeNet 1.1 behind the shipped file."""
    path = shared_data.parent / "weights" / "squeezenet1_1-imagenet.safetensors"
    if not path.is_file():
        pytest.skip(f"the original weights are not at {path}")
    return path


@pytest.fixture(scope="module")
def tensors() -> dict[str, torch.Tensor]:
    return read_tensors(FEATURES.path)


def quiet(step: str, done: int, total: int) -> None:
    """Ignore progress."""


def one_line(error: pytest.ExceptionInfo[InputError]) -> str:
    message = str(error.value)
    assert "\n" not in message
    return message


# The shipped file


def test_a_fresh_clone_has_what_the_default_network_starts_from():
    """The default network's weights are in the package, intact, and match its trunk exactly."""
    network = build("squeezeposenet")
    path = find(network.weights_name)
    assert path.parent == SHIPPED
    found = read_tensors(path)
    assert load_pretrained(network, found, path) == ()
    assert {str(tensor.dtype) for tensor in found.values()} == {"torch.float16"}
    for name, tensor in found.items():
        assert torch.equal(network.state_dict()[name], tensor.float()), name


def test_the_shipped_file_is_the_one_that_its_hash_belongs_to():
    """Size and SHA-256 match the catalogue: 722,496 parameters in float16 and a header."""
    content = FEATURES.path.read_bytes()
    assert hashlib.sha256(content).hexdigest() == FEATURES.sha256
    assert len(content) == FEATURES.size_bytes
    assert 2 * 722_496 < len(content) < 1.5e6


def test_its_licence_lies_beside_it_and_goes_with_the_package():
    """The MIT licence with its copyright line is included and named in pyproject.toml."""
    licence = SHIPPED / "LICENSE.squeezenet1_1-features.txt"
    assert "Copyright (c) 2019 Primoz Godec" in licence.read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert licence.relative_to(ROOT).as_posix() in project["license-files"]


def test_the_shipped_file_is_made_by_the_tool(original):
    """tools/shipped_weights.py reproduces the shipped file byte for byte."""
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys, hashlib; from pathlib import Path; sys.path.insert(0, 'tools');"
            "from shipped_weights import shipped;"
            "print(hashlib.sha256(shipped(Path(sys.argv[1]))).hexdigest())",
            str(original),
        ],
        cwd=ROOT,
        env={"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stdout.strip() == FEATURES.sha256, done.stderr


def test_rounding_changes_weights_by_less_than_a_two_thousandth(original, tensors):
    """Conversion to float16 (11 bits) changes weights by at most 2^-11 relative, or the smallest step."""
    exact = read_tensors(original)
    for name, tensor in tensors.items():
        error = (tensor.float() - exact[name]).abs()
        assert bool((error <= exact[name].abs() * 2**-11 + 2**-25).all()), name
        assert bool((error > 0).any()), name


def test_the_original_fits_a_network_that_keeps_conv10(original):
    """The published network loads completely with conv10; without it, only conv10 is left over."""
    whole = read_tensors(original)
    assert load_pretrained(build("squeezeposenet", {"conv10": True}), whole, original) == ()
    left = load_pretrained(build("squeezeposenet"), whole, original)
    assert sorted(left) == ["classifier.1.bias", "classifier.1.weight"]


def test_version_1_0_takes_weights_of_1_0_only(original):
    """SqueezeNet 1.0 weights load into version 1.0 and are rejected by version 1.1."""
    path = original.with_name("squeezenet1_0-imagenet-pruned.safetensors")
    network = build("squeezeposenet", {"version": "1.0"})
    left = load_pretrained(network, read_tensors(path), path)
    assert sorted(left) == ["classifier.1.bias", "classifier.1.weight"]
    with pytest.raises(InputError, match="belongs to another network"):
        load_pretrained(build("squeezeposenet"), read_tensors(path), path)


# The catalogue


def test_published_files_carry_their_hash_in_their_name():
    """torchvision files have https addresses and the first 8 digits of their SHA-256 in the name."""
    published = [weights for weights in CATALOGUE if weights.url is not None]
    assert [w.sha256 for w in published] == ["b8a52dc0", "b66bff10", "397923af", "1378be20"]
    for weights in published:
        assert weights.url == f"https://download.pytorch.org/models/{weights.file}"
        assert weights.file.endswith(f"-{weights.sha256}.pth")


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("squeezeposenet", {}),
        ("squeezeposenet", {"version": "1.0"}),
        ("squeezeposenet", {"conv10": True}),
        ("posenet", {}),
    ],
)
def test_every_network_names_weights_of_the_catalogue(name, options):
    """The default weights of each network are in the catalogue."""
    by_name(build(name, options).weights_name)


def test_fetched_files_are_kept_in_the_users_cache(tmp_path, monkeypatch):
    """The cache is in XDG_CACHE_HOME if that is an absolute path, otherwise in ~/.cache."""
    assert cache_folder() == tmp_path / "cache" / "squeezeposenet-toolkit" / "weights"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / "home" / ".cache" / "squeezeposenet-toolkit" / "weights"


# Loading


def test_loading_changes_the_pretrained_trunk_alone(tensors):
    """Loading weights changes only the trunk, not inserted normalisation layers, fc11 or the heads."""
    network = build("squeezeposenet")
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    load_pretrained(network, tensors, FEATURES.path)
    changed = {
        n for n, tensor in network.state_dict().items() if not torch.equal(tensor, before[n])
    }
    assert changed == set(tensors)


@pytest.mark.parametrize("zipped", [True, False])
def test_files_of_torch_are_read_in_both_formats(tensors, tmp_path, zipped):
    """Both torch.save formats are read: zip, and the older one of early torchvision files."""
    path = tmp_path / "mine.pth"
    torch.save(tensors, path, _use_new_zipfile_serialization=zipped)
    read = read_tensors(path)
    assert read.keys() == tensors.keys()
    assert all(torch.equal(read[name], tensor) for name, tensor in tensors.items())


def test_parameters_inside_a_training_programs_checkpoint_are_found(tensors, tmp_path):
    """Parameters under `state_dict` with a `module.` prefix, as in Places365 weights, are loaded."""
    path = tmp_path / "places.pth.tar"
    wrapped = {f"module.{name}": tensor for name, tensor in tensors.items()}
    torch.save({"epoch": 90, "state_dict": wrapped}, path)
    assert load_pretrained(build("squeezeposenet"), read_tensors(path), path) == ()


def test_googlenets_own_statistics_are_loaded_and_its_auxiliary_heads_are_not():
    """GoogLeNet's running statistics are loaded, but not its auxiliary heads, which were never trained."""
    source, network = build("posenet", seed=1), build("posenet", seed=2)
    for buffer in source.buffers():
        if buffer.is_floating_point():
            buffer.uniform_(0.5, 1.5)
    replaced = ("aux1.", "aux2.", "fc1.", "x.", "q.")
    published = {n: t for n, t in source.state_dict().items() if not n.startswith(replaced)}
    extra = ("fc.weight", "fc.bias", "aux1.conv.conv.weight", "aux2.fc2.bias")
    named = {**published, **{name: torch.ones(3) for name in extra}}
    heads_before = network.aux1.fc1.weight.clone()
    left = load_pretrained(network, named, Path("googlenet.pth"))
    assert sorted(left) == sorted(extra)
    assert torch.equal(network.conv2.bn.running_var, source.conv2.bn.running_var)
    assert torch.equal(network.aux1.fc1.weight, heads_before)
    without_counters = {n: t for n, t in named.items() if not n.endswith("num_batches_tracked")}
    load_pretrained(network, without_counters, Path("early.pth"))


def changed(tensors: dict[str, torch.Tensor], name: str, tensor: torch.Tensor | None):
    """Return the shipped tensors with one replaced or removed."""
    others = {n: t for n, t in tensors.items() if n != name}
    return others if tensor is None else {**others, name: tensor}


@pytest.mark.parametrize(
    ("name", "tensor", "message"),
    [
        ("features.12.squeeze.bias", None, "'features.12.squeeze.bias' is missing, which Squeeze"),
        ("features.13.weight", torch.ones(2), "SqueezePoseNet has no 'features.13.weight'"),
        (
            "features.0.weight",
            torch.ones(96, 3, 7, 7),
            "is 96 x 3 x 7 x 7, needs to be 64 x 3 x 3 x 3",
        ),
        ("features.0.bias", torch.ones(()), "'features.0.bias' is a single value, needs to be 64"),
        ("features.0.bias", torch.ones(64, dtype=torch.int64), "has type torch.int64"),
        ("features.0.bias", torch.ones(64, dtype=torch.complex64), "has type torch.complex64"),
        ("features.0.bias", torch.full((64,), torch.nan), "has values that are not finite"),
        ("features.0.bias", torch.full((64,), torch.inf), "has values that are not finite"),
        (
            "features.0.bias",
            torch.ones(64).to_sparse(),
            "has type torch.float32 (sparse)",
        ),
    ],
)
def test_tensors_that_do_not_fit_are_refused_before_anything_changes(
    tensors, name, tensor, message
):
    """An incompatible tensor raises a one-line error and leaves the network unchanged."""
    network = build("squeezeposenet")
    before = {n: t.clone() for n, t in network.state_dict().items()}
    with pytest.raises(InputError, match=re.escape(message)) as error:
        load_pretrained(network, changed(tensors, name, tensor), Path("w.safetensors"))
    assert one_line(error).startswith("w.safetensors: ")
    assert all(torch.equal(before[n], t) for n, t in network.state_dict().items())


# Hostile files


class Payload:
    """Object whose pickle creates a file when unpickled by an unsafe reader."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("suffix", [".pth", ".pt", ".safetensors"])
def test_code_inside_a_file_is_never_run(tensors, tmp_path, zipped, suffix):
    """A pickle with a payload is rejected under every file name without running it."""
    touched, path = tmp_path / "touched", tmp_path / f"evil{suffix}"
    content = {**tensors, "features.0.bias": Payload(touched)}
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    with pytest.raises(
        InputError, match=r"cannot be read as weights|not a safetensors file"
    ) as error:
        read_tensors(path)
    assert one_line(error).startswith(str(path))
    assert not touched.exists()
    with path.open("rb") as handle:
        torch.load(handle, weights_only=False)  # the payload itself works
    assert touched.exists()


@pytest.mark.parametrize("share", [0.0, 0.0001, 0.01, 0.5, 0.9999])
def test_a_safetensors_file_that_is_cut_short_is_refused(tmp_path, share):
    """A safetensors file truncated at any length is rejected."""
    content = FEATURES.path.read_bytes()
    path = tmp_path / "cut.safetensors"
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match="is not a safetensors file, or truncated"):
        read_tensors(path)


@pytest.mark.parametrize("share", [0.0, 0.0001, 0.01, 0.5, 0.9999])
@pytest.mark.parametrize("zipped", [True, False])
def test_a_file_of_torch_that_is_cut_short_is_refused(tensors, tmp_path, share, zipped):
    """A torch file truncated at any length is rejected, in both formats."""
    whole, path = tmp_path / "whole.pth", tmp_path / "cut.pth"
    torch.save(tensors, whole, _use_new_zipfile_serialization=zipped)
    path.write_bytes(whole.read_bytes()[: int(share * whole.stat().st_size)])
    with pytest.raises(InputError, match="cannot be read as weights") as error:
        read_tensors(path)
    one_line(error)


@pytest.mark.parametrize(
    "header",
    [
        b"{",
        b"[]",
        b'{"a": {"dtype": "F32", "shape": [1000000000000], "data_offsets": [0, 4000000000000]}}',
        b'{"a": {"dtype": "F32", "shape": [2], "data_offsets": [-8, 0]}}',
        b'{"a": {"dtype": "X9", "shape": [1], "data_offsets": [0, 4]}}',
        b'{"a": {"dtype": "F32", "shape": [18446744073709551615, 2], "data_offsets": [0, 4]}}',
    ],
)
def test_a_safetensors_header_that_lies_is_refused(tmp_path, header):
    """Headers with oversized, negative or overflowing sizes, or unknown types, are rejected."""
    path = tmp_path / "lies.safetensors"
    path.write_bytes(struct.pack("<Q", len(header)) + header + bytes(4))
    with pytest.raises(InputError, match="is not a safetensors file, or truncated"):
        read_tensors(path)


def test_a_header_that_claims_the_whole_memory_is_refused(tmp_path):
    """A header length of 2^63 is rejected without allocating memory."""
    path = tmp_path / "huge.safetensors"
    path.write_bytes(struct.pack("<Q", 2**63) + b"{}")
    with pytest.raises(InputError, match="is not a safetensors file, or truncated"):
        read_tensors(path)


def test_a_compressed_file_of_torch_is_refused(tmp_path):
    """A compressed torch file (64 MB of zeros in 64 KB) is rejected, as torch never compresses."""
    whole, path = tmp_path / "whole.pth", tmp_path / "bomb.pth"
    torch.save({"features.0.weight": torch.zeros(2**24)}, whole)
    with zipfile.ZipFile(whole) as source, zipfile.ZipFile(path, "w") as target:
        for entry in source.infolist():
            target.writestr(entry.filename, source.read(entry), zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 2e5
    with pytest.raises(InputError, match="its entries are compressed"):
        read_tensors(path)


@pytest.mark.parametrize(
    "content", [{}, [1, 2], torch.ones(3), {"a": 1}, {1: torch.ones(3)}, {"state_dict": {}}]
)
def test_a_file_without_named_tensors_is_refused(tmp_path, content):
    """Lists, single tensors, numbers and empty dictionaries are rejected."""
    path = tmp_path / "other.pth"
    torch.save(content, path)
    with pytest.raises(InputError, match="contains no parameters by name"):
        read_tensors(path)


def test_what_is_no_file_or_far_too_large_is_refused(tmp_path):
    """A folder and a (sparse) file of 3 GB are rejected."""
    with pytest.raises(InputError, match="is not a file of weights"):
        read_tensors(tmp_path)
    large = tmp_path / "large.pth"
    with large.open("wb") as handle:
        handle.truncate(3 * 10**9)
    with pytest.raises(InputError, match="is larger than 2 GB"):
        read_tensors(large)


# Finding


def test_weights_that_were_not_fetched_are_told_with_the_remedy():
    """Missing weights are not downloaded silently; the error names the fetch command."""
    with pytest.raises(InputError, match="weights vgg16 are not on this machine") as error:
        find("vgg16")
    assert "'spn-model weights fetch vgg16' downloads 553 MB, or give a file" in one_line(error)


def test_a_name_that_is_neither_file_nor_weights_is_told(tmp_path):
    """The error for an unknown name lists the available ones."""
    with pytest.raises(
        InputError,
        match="neither a file of weights nor one of the names squeezenet1_1-features, squeezenet",
    ):
        find(tmp_path / "places.pth")


def test_a_published_name_on_other_content_is_refused(tmp_path, cache):
    """A file whose content does not match the hash in its name is rejected, in the cache and elsewhere."""
    cache.mkdir(parents=True)
    for folder in (tmp_path, cache):
        (folder / "googlenet-1378be20.pth").write_bytes(b"half a download")
    assert state(by_name("googlenet")) == "damaged"
    for wanted in ("googlenet", tmp_path / "googlenet-1378be20.pth"):
        with pytest.raises(InputError, match="does not begin with 1378be20"):
            find(wanted)


def test_a_file_of_the_users_own_is_taken_as_it_is(tmp_path):
    """A date in the name of a user's file is not taken for a hash."""
    path = tmp_path / "trained-20261122.pth"
    path.write_bytes(b"")
    assert find(path) == find(str(path)) == path


# The download


class Server(http.server.ThreadingHTTPServer):
    """HTTP server with one content for every path, which counts requests and can redirect."""

    daemon_threads = False  # closing waits for them
    content = b""
    status = 200
    location = ""
    claimed = 0  # bytes announced beyond those sent
    requests = 0

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore clients that disconnect early, which is part of the tests."""

    def url(self, name: str) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/models/{name}"


class Answer(http.server.BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        self.server.requests += 1
        self.send_response(self.server.status)
        if self.server.location:
            self.send_header("Location", self.server.location)
        self.send_header("Content-Length", str(len(self.server.content) + self.server.claimed))
        self.end_headers()
        self.wfile.write(self.server.content)

    def log_message(self, *args: object) -> None:
        """Log nothing."""


@pytest.fixture
def server() -> Iterator[Server]:
    with Server(("127.0.0.1", 0), Answer) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.02,))
        thread.start()
        yield running
        running.shutdown()
        thread.join(10)


def served(server: Server, content: bytes, size_bytes: int | None = None):
    """Return weights whose file is on the server, named by the hash of its content."""
    server.content = content
    digest = hashlib.sha256(content).hexdigest()[:8]
    file = f"small-{digest}.pth"
    size = len(content) if size_bytes is None else size_bytes
    return replace(
        by_name("googlenet"), file=file, sha256=digest, size_bytes=size, url=server.url(file)
    )


def test_a_download_lands_in_the_cache_and_is_made_once(server, cache):
    """A download is verified, cached and not repeated; a damaged file is replaced."""
    weights = served(server, b"w" * 3_000_000)
    steps = []
    path = fetch(weights, lambda *step: steps.append(step))
    assert path.read_bytes() == server.content
    assert path.parent == cache
    assert steps[0] == ("MB", 1, 3)
    assert steps[-1] == ("MB", 3, 3)
    assert fetch(weights, quiet) == path
    assert server.requests == 1
    path.write_bytes(b"")
    assert fetch(weights, quiet).read_bytes() == server.content
    assert [found.name for found in cache.iterdir()] == [weights.file]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        ({"content": b"other"}, "the downloaded file has SHA-256"),
        ({"content": b"w" * 5_000_000}, "the download is larger than the 0 MB expected"),
        ({"status": 404}, "download failed (Not Found)"),
        ({"status": 503}, "download failed (Service Unavailable)"),
        (
            {"content": b"sma", "claimed": 2},
            "download failed (the connection was lost after 3 B",
        ),
    ],
)
def test_a_download_that_fails_leaves_nothing(server, cache, spoil, message):
    """Wrong or oversized content, HTTP errors and lost connections give one line and an empty cache."""
    weights = served(server, b"small")
    for name, value in spoil.items():
        setattr(server, name, value)
    with pytest.raises(InputError, match=re.escape(message)) as error:
        fetch(weights, quiet)
    assert one_line(error).startswith(server.url(weights.file))
    assert list(cache.iterdir()) == []


def test_a_redirection_to_an_insecure_address_is_not_followed():
    """Redirects from https to http or ftp are refused; those to https are followed."""
    import urllib.error
    import urllib.request

    from spn_model.pretrained.weights import _StaySecure

    request = urllib.request.Request("https://download.pytorch.org/models/a.pth")
    follow = _StaySecure().redirect_request
    for insecure in ("http://download.pytorch.org/a.pth", "ftp://a/b"):
        with pytest.raises(urllib.error.URLError, match="insecure"):
            follow(request, None, 302, "Found", {}, insecure)
    assert follow(request, None, 302, "Found", {}, "https://cdn.pytorch.org/a.pth") is not None


def test_without_a_network_the_line_says_what_to_do(cache):
    """The error for a failed download says where to put a file fetched elsewhere."""
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    weights = replace(by_name("googlenet"), url=f"http://127.0.0.1:{port}/small.pth")
    with pytest.raises(InputError, match="download failed") as error:
        fetch(weights, quiet)
    wanted = f"download it elsewhere and put it at {cache / weights.file}, or give its path"
    assert wanted in one_line(error)


def test_shipped_weights_need_no_fetching():
    """Fetching shipped weights returns their path in the package."""
    assert fetch(FEATURES, quiet) == FEATURES.path


# The command


def invoke(*words: str):
    return CliRunner(env={"COLUMNS": "200"}).invoke(main, ["weights", *words])


def test_the_list_shows_what_is_here_and_what_is_not(cache):
    """The list shows name, contents, presence, origin, size and hash, and marks damaged files."""
    shown = invoke()
    assert shown.exit_code == 0
    rows = {line.split()[0]: line for line in shown.output.splitlines() if line.strip()}
    for weights in CATALOGUE:
        row = rows[weights.name]
        assert weights.holds in row
        assert weights.sha256[:8] in row
        assert f"{weights.size_bytes / 1e6:.1f} MB" in row
    assert re.search(r" yes +this package +1\.4 MB", rows["squeezenet1_1-features"])
    assert re.search(r" no +download\.pytorch\.org +553\.4 MB", rows["vgg16"])
    assert str(cache) in shown.output
    assert "damaged" not in shown.output
    cache.mkdir(parents=True)
    by_name("vgg16").path.write_bytes(b"")
    assert "damaged files are not used" in invoke().output


def test_fetching_what_is_shipped_tells_where_it_lies():
    """Fetching shipped weights exits with 0 and prints path and licence."""
    shown = invoke("fetch", FEATURES.name)
    assert shown.exit_code == 0
    assert str(FEATURES.path) in shown.output.replace("\n", "")
    assert "MIT" in shown.output


def test_fetching_an_unknown_name_is_one_line_and_exit_1():
    """An unknown name gives exit code 1 and a one-line error with the available names."""
    shown = invoke("fetch", "resnet")
    assert shown.exit_code == 1
    names = ", ".join(weights.name for weights in CATALOGUE)
    assert shown.output == f"Error: unknown weights 'resnet'; choose one of {names}\n"


def test_listing_and_help_load_no_torch():
    """Listing and help do not import torch."""
    code = (
        "import sys\n"
        "from spn_cli.model import main\n"
        "for words in (['weights'], ['weights', 'fetch', '--help']):\n"
        "    try:\n"
        "        main(words)\n"
        "    except SystemExit as end:\n"
        "        assert end.code == 0\n"
        "assert 'torch' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_saved_trunks_are_read_back(tmp_path):
    """A trunk saved as safetensors can initialise another network."""
    source, network = build("squeezeposenet", seed=1), build("squeezeposenet", seed=2)
    path = tmp_path / "own.safetensors"
    wanted = read_tensors(FEATURES.path).keys()
    save_file({name: source.state_dict()[name] for name in wanted}, path)
    load_pretrained(network, read_tensors(path), path)
    for name in wanted:
        assert torch.equal(network.state_dict()[name], source.state_dict()[name])
