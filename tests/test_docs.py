"""README and docs say what is there: links, files and fields of an area, packages, errors."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest

from spn_data import errors
from spn_data.area.names import STAGES
from spn_data.capture.selection import SelectionOptions
from spn_data.reconstruction.attempts import ReconstructOptions
from spn_data.reconstruction.diagnosis import FrameRegistration
from spn_data.storage.stage_record import StageRecord

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").glob("*.md")])
ERRORS = [
    name
    for name, value in vars(errors).items()
    if isinstance(value, type) and issubclass(value, errors.SpnError)
]


def page(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def prose(text: str) -> str:
    """A page without its fenced blocks."""
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)


def anchors(text: str) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.+)$", prose(text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    """Every link inside the project leads to a file, and to a heading where it names one."""
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(path.read_text(encoding="utf-8"))):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        found = path if not file else path.parent / file
        assert found.exists(), target
        if anchor:
            assert anchor in anchors(found.read_text(encoding="utf-8")), target


def test_every_page_is_linked_from_the_readme():
    """No page of docs/ lies unseen."""
    for path in (ROOT / "docs").glob("*.md"):
        assert f"](docs/{path.name})" in page("README.md"), path.name


def test_make_targets_of_the_readme_are_there():
    """`make X` in the README is a target of the Makefile."""
    targets = set(
        re.findall(
            r"\bmake ([a-z-]+)",
            "\n".join(re.findall(r"```sh\n(.*?)```", page("README.md"), re.DOTALL)),
        )
    )
    assert {"demo", "test"} <= targets
    for target in targets:
        assert re.search(rf"^{target}:", page("Makefile"), re.MULTILINE), target


def test_programs_of_the_readme_are_there():
    """`python X.py` in the README names a file of the project."""
    programs = re.findall(r"^python (\S+\.py)", page("README.md"), re.MULTILINE)
    assert programs
    for program in programs:
        assert (ROOT / program).is_file()


def test_each_dependency_has_its_reason():
    """docs/dependencies.md has one row for each package that pyproject.toml asks for."""
    project = tomllib.loads(page("pyproject.toml"))["project"]
    wanted = [*project["dependencies"]]
    for extra in project["optional-dependencies"].values():
        wanted += extra
    rows = re.findall(r"^\| `([^`]+)` \| (.{8,}) \|$", page("docs/dependencies.md"), re.MULTILINE)
    names = {re.match(r"[\w-]+", w)[0] for w in wanted} - {project["name"]}
    assert sorted(name for name, _ in rows) == sorted(names)


def test_the_stages_are_those_documented():
    """The folders of an area in README and formats.md are those that the program makes."""
    for name in ("README.md", "docs/formats.md"):
        for stage in STAGES:
            assert f"  {stage}/" in page(name)


def section(text: str, title: str) -> str:
    """The part of a page under a heading that begins so; `#` inside a fenced block is no heading."""
    fences = [found.span() for found in re.finditer(r"^```.*?^```", text, re.MULTILINE | re.DOTALL)]
    headings = [
        found
        for found in re.finditer(r"^#+ (.+)\n", text, re.MULTILINE)
        if not any(first < found.start() < last for first, last in fences)
    ]
    for found, following in zip(headings, [*headings[1:], None], strict=True):
        if found[1].startswith(title):
            return text[found.end() : len(text) if following is None else following.start()]
    raise AssertionError(f"no heading {title!r}")


def first_cells(text: str) -> list[str]:
    """Names in the first column of a section's tables."""
    rows = re.findall(r"^\| (`[^|]+) \|", text, re.MULTILINE)
    return [name for row in rows for name in re.findall(r"`([^`]+)`", row)]


def test_fields_of_stage_json_are_documented():
    """formats.md lists the fields of a stage's record, and no others."""
    listed = first_cells(section(page("docs/formats.md"), "stage.json"))
    assert sorted(listed) == sorted([*(f.name for f in fields(StageRecord)), "version"])


def test_columns_of_registration_csv_are_documented():
    """formats.md lists the columns of registration.csv in their order."""
    listed = first_cells(section(page("docs/formats.md"), "2-model/registration.csv"))
    assert listed == [f.name for f in fields(FrameRegistration)]


def test_columns_of_telemetry_are_documented():
    """formats.md lists the columns of a telemetry file in their order, and its example has them."""
    from spn_data.telemetry.table import _COLUMNS

    text = section(page("docs/formats.md"), "1-frames/telemetry/")
    assert first_cells(text) == _COLUMNS.split(",")
    assert f"\n{_COLUMNS}\n" in text


def test_columns_of_frames_csv_are_documented():
    """input.md lists the columns of frames.csv in their order, and the example has them."""
    from spn_data.capture.frames import _COLUMNS

    assert first_cells(section(page("docs/input.md"), "frames.csv")) == list(_COLUMNS)
    assert f"\n{','.join(_COLUMNS)}\n" in section(page("docs/formats.md"), "1-frames/frames.csv")


def test_examples_of_tables_are_read_by_the_program(tmp_path):
    """The examples in formats.md are files that the readers accept."""
    from spn_data.capture.frames import read_frames
    from spn_data.telemetry.table import read_track

    blocks = re.findall(r"```csv\n(.*?)```", page("docs/formats.md"), re.DOTALL)
    (frames,) = (block for block in blocks if block.startswith("name,sequence"))
    (track,) = (block for block in blocks if block.startswith("# {"))
    (tmp_path / "frames.csv").write_text(frames)
    (tmp_path / "track.csv").write_text(track)
    assert len(read_frames(tmp_path / "frames.csv")) == 1
    assert read_track(tmp_path / "track.csv").lat_lon_deg[0, 0] == 46.842607083333334


def test_counts_of_a_stage_are_documented():
    """formats.md names every count that the stages record."""
    text = section(page("docs/formats.md"), "stage.json")
    for name in ("frames", "model", "geo"):
        tree = ast.parse(page(f"spn_data/pipeline/{name}_stage.py"))
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and node.name == "_counts":
                returned = next(n for n in ast.walk(node) if isinstance(n, ast.Return)).value
            elif isinstance(node, ast.keyword) and node.arg == "counts":
                returned = node.value
            else:
                continue
            if isinstance(returned, ast.Dict):
                for key in returned.keys:
                    assert f"`{ast.literal_eval(key)}`" in text, f"{name}: {ast.literal_eval(key)}"


def text_of(node: ast.AST) -> str | None:
    """A string of the source, with an ellipsis for what is filled in."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(part) or "\u2026" for part in node.values)
    return None


def sources() -> list[ast.Module]:
    paths = [
        p
        for package in ("spn_data", "spn_model", "cli")
        for p in sorted((ROOT / package).rglob("*.py"))
    ]
    return [ast.parse(path.read_text(encoding="utf-8")) for path in paths]


def raised() -> Iterator[str]:
    """Messages of all errors that are raised for the user, where they are written out on the spot."""
    for tree in sources():
        for node in ast.walk(tree):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                called = node.exc.func
                if isinstance(called, ast.Name) and called.id in ERRORS and node.exc.args:
                    message = text_of(node.exc.args[0])
                    if message is not None:
                        yield message


def documented() -> list[str]:
    """Messages in troubleshooting.md: of errors and notes, not what the user sees otherwise."""
    text = page("docs/troubleshooting.md").split("## Results that look wrong")[0]
    return first_cells(text) + re.findall(r"^\| note: `([^`]+)`", text, re.MULTILINE)


def words_in_order(message: str, text: str) -> bool:
    """Whether a documented message, its ellipses for anything, is part of a message of the program."""
    position = 0
    for part in (part.strip() for part in message.split("\u2026")):
        position = text.find(part, position)
        if position < 0:
            return False
        position += len(part)
    return True


def test_documented_messages_are_what_the_program_says():
    """Every message of troubleshooting.md is one that the source holds."""
    said = [text for tree in sources() for node in ast.walk(tree) if (text := text_of(node))]
    assert len(documented()) > 60
    assert [m for m in documented() if not any(words_in_order(m, text) for text in said)] == []


def test_what_the_program_says_is_documented():
    """Every error that a module raises for the user has its row in troubleshooting.md."""
    messages = list(raised())
    assert len(messages) > 60
    assert [m for m in messages if not any(words_in_order(d, m) for d in documented())] == []


def test_figures_of_the_reconstruction_page_are_the_defaults():
    """Numbers in the text of reconstruct.md are those of the option classes."""
    options = ReconstructOptions()
    pairs, features = options.pairs, options.features
    text = " ".join(page("docs/reconstruct.md").split())
    far = [pairs.overlap * 2**k for k in range(1, pairs.far_steps + 1)]
    for sentence in (
        f"at most {features.max_image_size_px:,} pixels, the {features.max_features:,} strongest",
        f"the next {pairs.overlap} of its sequence",
        f"those {', '.join(map(str, far[:-1]))} and {far[-1]} further",
        f"the {pairs.spatial_neighbors} nearest by telemetry within {pairs.spatial_max_m:g} m",
        f"the {pairs.appearance_neighbors} that look most alike",
        f"needs {options.matching.min_inliers} inliers",
        f"fewer than {options.enough_share * 100:g} % are in",
        f"than {options.usable_share * 100:g} % of all frames",
        f"COLMAP's {options.camera_model} model",
    ):
        assert sentence in text


def test_options_of_the_choice_of_frames_are_documented_with_their_defaults():
    """input.md's table has the defaults of the option class."""
    text = section(page("docs/input.md"), "How frames are chosen")
    rows = re.findall(r"^\| `(.+)` \| ([^|]+) \|", text, re.MULTILINE)
    assert len(rows) > 5
    for names, values in rows:
        for name, value in zip(names.split("`, `"), values.split(","), strict=True):
            default = getattr(SelectionOptions(), name)
            assert default == (None if value == "none" else float(value.strip(" m"))), name
    blur = f"below {SelectionOptions().blur_ratio:g} of their median, a frame is blurred"
    assert blur in " ".join(text.split())
