"""The rules of docs/architecture.md, checked on the source code."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tools.module_list import with_list

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("spn_data", "spn_model", "cli/spn_cli")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
NAMES = [path.relative_to(ROOT).as_posix() for path in MODULES]


@cache
def _tree(path: Path) -> ast.Module:
    """Return the syntax tree of a module."""
    return ast.parse(path.read_text(encoding="utf-8"))


def _imports(path: Path) -> Iterator[str]:
    """Yield the full names of everything that a module imports, also inside functions."""
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            assert node.module is not None
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _importers(library: str) -> set[str]:
    """Return our modules that import a library or anything in it."""
    return {
        name
        for name, path in zip(NAMES, MODULES, strict=True)
        if any(full == library or full.startswith(f"{library}.") for full in _imports(path))
    }


def _outside(names: set[str], *folders: str) -> set[str]:
    """Return the names outside the given folders."""
    return {name for name in names if not name.startswith(folders)}


def test_the_packages_are_found():
    """The source files are found, so that the rules below apply to something."""
    assert len(NAMES) > 50
    assert "spn_data/geometry/pose.py" in NAMES


def test_pycolmap_is_imported_in_one_place():
    """Only spn_data/colmap/__init__.py imports pycolmap."""
    assert _importers("pycolmap") == {"spn_data/colmap/__init__.py"}


def test_only_colmap_knows_pycolmaps_objects():
    """Only spn_data.colmap uses the pycolmap module that it re-exports."""
    assert _outside(_importers("spn_data.colmap.pycolmap"), "spn_data/colmap/") == set()


def test_pyav_stays_with_video():
    """Only modules that open, decode or encode videos or search them for subtitles import PyAV."""
    assert _importers("av") == {
        "spn_data/capture/video_container.py",
        "spn_data/media/container.py",
        "spn_data/simulate/video_out.py",
    }


def test_hdf5_stays_with_the_data_set():
    """Only the modules that write and read dataset.h5 import h5py."""
    assert _importers("h5py") == {
        "spn_data/dataset/hdf5_writer.py",
        "spn_data/dataset/hdf5_reader.py",
    }


@pytest.mark.parametrize("library", ["click", "rich"])
def test_the_terminal_belongs_to_cli(library):
    """Only cli/ imports click and rich."""
    found = _importers(library)
    assert found
    assert _outside(found, "cli/") == set()


@pytest.mark.parametrize("library", ["torch", "spn_model", "spn_cli"])
def test_spn_data_stands_alone(library):
    """spn_data imports neither torch nor spn_model nor the command line."""
    assert {n for n in _importers(library) if n.startswith("spn_data/")} == set()


def test_spn_model_knows_no_command_line():
    """spn_model imports neither spn_cli nor pycolmap, not even through spn_data.colmap."""
    found = _importers("spn_cli") | _importers("pycolmap") | _importers("spn_data.colmap")
    assert {n for n in found if n.startswith("spn_model/")} == set()


def test_only_pipeline_inputs_and_cli_know_the_area():
    """Only pipeline, inputs, Python interface and command line import the area."""
    allowed = (
        "spn_data/area/",
        "spn_data/pipeline/",
        "spn_data/inputs/",
        "spn_data/api.py",
        "cli/",
    )
    assert _outside(_importers("spn_data.area.area"), *allowed) == set()


def test_only_cli_and_the_python_interface_know_the_pipeline():
    """Only command line and Python interface import the pipeline."""
    allowed = ("spn_data/pipeline/", "spn_data/api.py", "cli/")
    assert _outside(_importers("spn_data.pipeline"), *allowed) == set()


GEOMETRY = [name for name in NAMES if name.startswith("spn_data/geometry/")]


@pytest.mark.parametrize("name", ["spn_data/errors.py", *GEOMETRY])
def test_geometry_knows_arrays_only(name):
    """Modules of spn_data.geometry import only errors and each other."""
    ours = {full for full in _imports(ROOT / name) if full.startswith("spn_")}
    allowed = ("spn_data.errors.", "spn_data.geometry.")
    assert {full for full in ours if not full.startswith(allowed)} == set()


def test_on_board_needs_errors_and_geometry_only():
    """Rooms that run on board import only spn_data.errors, spn_data.geometry and each other.

    HEIC and DNG need other packages, so they are decoded by the function that decodes them elsewhere.
    """
    optional = "spn_data.capture.photos.decode_photo"
    values = ("spn_data.errors.", "spn_data.geometry.")
    # Features on board are detected, compared and followed as those of the map.
    features = tuple(f"spn_data.matching.{name}." for name in ("features", "patches", "putative"))
    rooms = {
        "spn_model/landmarks/": (
            *values,
            *features,
            "spn_model.landmarks.",
            "spn_model.integrity.",
        ),
        "spn_model/onboard/": (
            *(*values, *features, optional),
            *(
                "spn_model.onboard.",
                "spn_model.landmarks.",
                "spn_model.integrity.",
                "spn_model.autopilot.",
            ),
        ),
        "spn_model/integrity/": (*values, "spn_model.integrity."),
        "spn_model/autopilot/": (*values, "spn_model.autopilot.", "spn_model.integrity."),
    }
    for room, allowed in rooms.items():
        names = [name for name in NAMES if name.startswith(room)]
        assert names, room
        for name in names:
            ours = {full for full in _imports(ROOT / name) if full.startswith("spn_")}
            assert {full for full in ours if not full.startswith(allowed)} == set(), name


LIGHT_ROOMS = ("spn_model/integrity/", "spn_model/autopilot/")


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith(LIGHT_ROOMS)])
def test_integrity_and_autopilot_load_only_numpy(name):
    """At their head, modules of these rooms import only the standard library, NumPy and ours."""
    known = {*sys.stdlib_module_names, "numpy", "spn_data", "spn_model"}
    heads = [
        node for node in _tree(ROOT / name).body if isinstance(node, ast.Import | ast.ImportFrom)
    ]
    found = {alias.name for node in heads if isinstance(node, ast.Import) for alias in node.names}
    found |= {node.module or "" for node in heads if isinstance(node, ast.ImportFrom)}
    assert {full for full in found if full.split(".")[0] not in known} == set()


def _module(path: Path) -> str:
    """Return the dotted name of one of our modules."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts[1:] if parts[0] == "cli" else parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _graph() -> dict[str, set[str]]:
    """Return the modules of ours that each module imports."""
    names = {_module(path) for path in MODULES}
    graph = {}
    for path in MODULES:
        found = {full if full in names else full.rpartition(".")[0] for full in _imports(path)}
        graph[_module(path)] = (found & names) - {_module(path)}
    return graph


def _cycles(graph: dict[str, set[str]]) -> list[str]:
    """Return the nodes that can reach themselves."""

    def reach(start: str) -> set[str]:
        seen: set[str] = set()
        waiting = [start]
        while waiting:
            for name in graph.get(waiting.pop(), set()) - seen:
                seen.add(name)
                waiting.append(name)
        return seen

    return [name for name in graph if name in reach(name)]


def test_the_check_for_cycles_finds_one():
    """`_cycles` finds a cycle of three and accepts a diamond."""
    assert _cycles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == ["a", "b", "c"]
    assert _cycles({"a": {"b", "c"}, "b": {"d"}, "c": {"d"}, "d": set()}) == []


def test_no_modules_import_each_other():
    """The modules have no import cycle, including imports in functions and for type checking."""
    assert _cycles(_graph()) == []


def test_no_folders_import_each_other():
    """The folders of the packages have no import cycle."""
    rooms: dict[str, set[str]] = {}
    for name, found in _graph().items():
        room = ".".join(name.split(".")[:2])
        rooms.setdefault(room, set()).update(".".join(other.split(".")[:2]) for other in found)
    for room, found in rooms.items():
        found.discard(room)
    assert len(rooms) > 25
    assert _cycles(rooms) == []


@pytest.mark.parametrize(("package", "most"), [("spn_data", 6), ("spn_model", 4)])
def test_few_modules_are_at_the_top(package, most):
    """Only a few modules are at the top level of a package."""
    assert len(list((ROOT / package).glob("*.py"))) <= most


def _code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return the number of lines of a function after its docstring."""
    first = function.body[0]
    start = first.end_lineno if ast.get_docstring(function) else function.lineno
    return (function.end_lineno or 0) - (start or 0)


def test_no_function_is_long():
    """No function has more than 80 lines of code after its docstring."""
    found = [
        f"{name}:{node.lineno} {node.name}"
        for name, path in zip(NAMES, MODULES, strict=True)
        for node in ast.walk(_tree(path))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and _code_lines(node) > 80
    ]
    assert found == []


def test_no_two_public_classes_share_a_name():
    """No two public classes have the same name."""
    seen: dict[str, str] = {}
    for name, path in zip(NAMES, MODULES, strict=True):
        for node in _tree(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                assert node.name not in seen, f"{name} and {seen[node.name]}: {node.name}"
                seen[node.name] = name


def test_the_library_never_prints():
    """spn_data and spn_model never print, prompt, exit or break into a debugger."""
    found = [
        f"{name}:{node.lineno}"
        for name, path in zip(NAMES, MODULES, strict=True)
        if not name.startswith("cli/")
        for node in ast.walk(_tree(path))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in ("print", "input", "exit", "breakpoint")
    ]
    assert found == []


def test_nothing_is_pickled():
    """No module uses pickle or similar formats, since stored files must not carry code."""
    for library in ("pickle", "shelve", "joblib", "dill"):
        assert _importers(library) == set()


def test_xml_goes_through_defusedxml():
    """No module imports a standard XML parser, unsafe for untrusted input; only two XML types are allowed."""
    for name, path in zip(NAMES, MODULES, strict=True):
        found = {full for full in _imports(path) if full.split(".")[0] in ("xml", "lxml")}
        allowed = {"xml.etree.ElementTree.ParseError", "xml.etree.ElementTree.Element"}
        assert found <= allowed, name


@pytest.mark.parametrize("name", NAMES)
def test_no_module_is_long(name):
    """No module has more than 400 lines."""
    assert len((ROOT / name).read_text(encoding="utf-8").splitlines()) <= 400


@pytest.mark.parametrize("name", NAMES)
def test_every_module_says_what_it_is(name):
    """Every module with code has a docstring."""
    tree = ast.parse((ROOT / name).read_text(encoding="utf-8"))
    assert not tree.body or ast.get_docstring(tree)


def test_the_list_of_modules_is_current():
    """docs/architecture.md lists every module with the first line of its docstring."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert with_list(page) == page


def _run(code: str) -> str:
    """Run Python code in a new process and return its output."""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("command", ["data", "model"])
def test_help_is_quick(command):
    """--help of a program loads none of the heavy libraries."""
    heavy = ("torch", "pycolmap", "cv2", "av", "scipy")
    loaded = _run(
        "import sys\n"
        f"from spn_cli.{command} import main\n"
        "try:\n"
        "    main(['--help'])\n"
        "except SystemExit as end:\n"
        "    assert end.code == 0\n"
        f"print('LOADED', [name for name in {heavy} if name in sys.modules])"
    )
    assert "Usage:" in loaded
    assert loaded.rstrip().endswith("LOADED []")


def test_help_of_every_command_is_quick():
    """--help of a subcommand loads neither torch nor pycolmap."""
    loaded = _run(
        "import sys\n"
        "from spn_cli.data import main\n"
        "for name in main.commands:\n"
        "    try:\n"
        "        main([name, '--help'])\n"
        "    except SystemExit as end:\n"
        "        assert end.code == 0\n"
        "print('LOADED', [name for name in ('torch', 'pycolmap') if name in sys.modules])"
    )
    assert loaded.count("Usage:") >= 4
    assert loaded.rstrip().endswith("LOADED []")


def test_png_can_be_written_beside_pycolmap(tmp_path):
    """Writing a PNG works because spn_data.colmap loads cv2 before pycolmap; the other order aborts."""
    path = tmp_path / "image.png"
    _run(
        "import spn_data.colmap\n"
        "import cv2, numpy\n"
        f"assert cv2.imwrite({str(path)!r}, numpy.zeros((4, 4, 3), numpy.uint8))"
    )
    assert path.read_bytes().startswith(b"\x89PNG")


def _tracked() -> list[Path]:
    """Return the files tracked by git."""
    done = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, timeout=30)
    if done.returncode != 0:
        pytest.skip("this is no git checkout")
    paths = [ROOT / name for name in done.stdout.decode().split("\0") if name]
    return [path for path in paths if path.is_file()]


def test_no_file_names_a_machine():
    """No tracked file contains an absolute path on a particular machine."""
    places = re.compile(rb"(?<![\w.])/(?:work|home|root|Users|mnt|tmp)/\w")
    found = [
        f"{path.relative_to(ROOT)}: {hit[0].decode()}"
        for path in _tracked()
        for hit in places.finditer(path.read_bytes())
    ]
    assert found == []
