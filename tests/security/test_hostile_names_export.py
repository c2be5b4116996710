"""Text of a bundle's author in exported files: whatever it says, files compile, load, and hold it as text only."""

from __future__ import annotations

import ast
import csv
import importlib.util
import io
import json
import re
import shutil
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import scipy.io
import yaml
from markdown_it import MarkdownIt

from edp.data.features import FeatureSet
from edp.data.scaling import Scaler
from edp.data.task import TargetMode, Task
from edp.errors import ExportError
from edp.export import TARGETS, escape, make_target
from edp.export.fmu.interface import OWN
from edp.ir.w8a16 import calibrate
from edp.networks import build_model
from edp.networks.backbones import LstmSpec
from edp.networks.heads import MlpHead
from edp.networks.integer import IntegerPredictor
from edp.networks.predictor import ModelSpec
from edp.settings.provenance import Provenance
from edp.signals import Channel, Kind
from edp.training.bundle import Bundle

MARK = "pwned"
"""A file of this name is what every attack tries to make."""
ATTACK = (
    "extern int creat(const char *, unsigned); __attribute__((constructor)) static void p(void)"
    f'{{creat("{MARK}",420);}}'
)
HOSTILE = (
    f"x*/ {ATTACK} /*",
    f"x*\\\n/ {ATTACK} /*",
    f"x*??/\n/ {ATTACK} /*",
    f"x\n{ATTACK}\n//",
    f"x\r{ATTACK}",
    f"x\u2028{ATTACK}\u2029",
    f'"}}; {ATTACK} "',
    "ends in a backslash \\",
    "ends in a trigraph ??/",
    "??????/ ??' ??( %:include",
    "nested /* comment */ // and more",
    "\u202eesrever\u202c \u2066x\u2069 \u200f",
    "nul\0inside, \x07 bell, \x1b[31m red, \x7f, \x85",
    "lone \ud800 surrogate",
    "astral \U0001f600, e\u0301, \u00e4, \uff0f\uff0a",
    "</script><script>alert(1)</script><img src=x onerror=alert(1)>",
    "]]> <!-- --> &amp; <!ENTITY x SYSTEM 'file:///etc/passwd'>",
    "[/b] [bold]x[/bold] [click](javascript:alert(1)) ![i](http://example.org/x.png) www.example.org",
    "| cell | `code` *strong* _em_ ~~x~~ # head $m$ http://example.org",
    "%s %n %d %%", "$(touch pwned)", "`touch pwned`", "; touch pwned #",
    "${CMAKE_CURRENT_SOURCE_DIR} $ENV{HOME} @VAR@ [[x]]", "${name} $name $$ ${", "{{ x }} {% raw %} {0} {x.__class__}",
    "a: #b", "- item", "!!python/object/apply:os.system ['touch pwned']", "&anchor *alias", "'", '"', "''", '"""',
    "'); system('touch pwned'); ('", "%{\nsystem('touch pwned')\n%}", "x ...\n system('touch pwned');",
    "=cmd|' /C calc'!A0", "+1", "-1", "@SUM(A1)", "a=b", "a=pressure:b",
    "", " ", "\t", "_", "1", "int", "class", "end", "function", "lambda", "in", "out", "NULL", "status",
    "time", "a b", "a-b", "a.b",
    "x" * 10_000, "x" * 10_001,
)  # fmt: skip
QUICK = {"fmu": {"binaries": "none"}, "c": {"tangent": True}}
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wtrigraphs", "-Wbidi-chars=any", "-Werror", "-O0", "-fPIC")


def small(names: tuple[str, ...], whole: bool = False) -> Bundle:
    """A tiny network whose channels, targets and descriptions are `names`."""
    features, shape = FeatureSet(names[0] or "set", names), (2, 3)
    task = Task(features, (names[0], names[2], names[-1]), (1, 4), TargetMode.ABSOLUTE, 100.0)
    scaler = Scaler(np.zeros(len(names)), np.ones(len(names)), np.zeros(shape), np.ones(shape))
    predictor = build_model(
        task, ModelSpec(backbone=LstmSpec(units=2), head=MlpHead(hidden=2), window=3), scaler, seed=0
    ).eval()
    if whole:
        rows = np.random.default_rng(0).normal(size=(60, len(names))).astype(np.float32)
        predictor = IntegerPredictor(predictor, calibrate(predictor.graph(), [rows]))
    inputs = tuple(Channel(name, Kind.PRESSURE, name) for name in names)
    texts = (HOSTILE[1], HOSTILE[0], HOSTILE[6])
    return Bundle(
        predictor, inputs, (Kind.VELOCITY,) * 3, texts, Provenance(more={"note": HOSTILE[0]}), {"note": HOSTILE[0]}
    )


@dataclass(frozen=True)
class Made:
    bundle: Bundle
    folders: dict[str, Path]

    def text(self, target: str, file: str) -> str:
        return (self.folders[target] / file).read_text(encoding="utf-8")

    @property
    def names(self) -> list[str]:
        return [channel.name for channel in self.bundle.inputs]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    """The hostile bundle in every form of the registry; FMUs unpacked."""
    bundle, folders = small(HOSTILE), {}
    for target in TARGETS:
        folders[target] = tmp_path_factory.mktemp(target)
        make_target(target, QUICK.get(target)).write(bundle, "predictor", folders[target])
    for version in (2, 3):
        folders[f"fmi{version}"] = tmp_path_factory.mktemp(f"fmi{version}")
        with zipfile.ZipFile(folders["fmu"] / f"predictor_fmi{version}.fmu") as archive:
            archive.extractall(folders[f"fmi{version}"])
    return Made(bundle, folders)


def compiled_and_loaded(folder: Path, sources: list[Path], compiler: str, *flags: object) -> None:
    """A library of the sources, without a warning, and loaded: constructors run."""
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}")
    library = folder / f"lib_{compiler}.so"
    given = [flag for flag in STRICT if compiler == "gcc" or "bidi" not in flag]
    command = [compiler, *given, *map(str, flags), "-shared", *map(str, sources), "-lm", "-o", str(library)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    load = "import ctypes, sys; ctypes.CDLL(sys.argv[1])"
    subprocess.run([sys.executable, "-c", load, str(library)], cwd=folder, check=True)
    assert not list(folder.rglob(MARK))


C_PARTS = {
    "c": ("predictor.c", "predictor_tangent.c", "edp_*.c"),
    "casadi": ("*.c",),
    "ros2": ("predictor_ros/csrc/*.c",),
    "simulink": ("predictor_call.c", "core/*.c"),
    "fmi2": ("sources/*.c",),
    "fmi3": ("sources/*.c",),
}


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("part", list(C_PARTS))
def test_c_compiles_without_warnings_and_does_nothing_when_loaded(part, compiler, made):
    folder = made.folders[part]
    sources = [path for pattern in C_PARTS[part] for path in sorted(folder.glob(pattern))]
    compiled_and_loaded(folder, sources, compiler, "-I", folder / "core")


def test_the_host_test_compiles_and_passes(made, tmp_path):
    if shutil.which("gcc") is None:
        pytest.skip("needs gcc")
    folder = made.folders["c"]
    subprocess.run(["gcc", *STRICT, "-c", folder / "example_task.c", "-o", tmp_path / "task.o"], check=True)
    for program in ("host_test.c", "fuzz.c"):
        sources = [folder / program, folder / "predictor.c", *folder.glob("edp_[rm]*.c")]
        more = ["-DREPLAY"] if program == "fuzz.c" else []
        command = ["gcc", *STRICT[:7], "-O1", *more, *map(str, sources), "-lm", "-o", str(tmp_path / "program")]
        assert subprocess.run(command, capture_output=True).returncode == 0
        done = subprocess.run([tmp_path / "program"], cwd=tmp_path, capture_output=True)
        assert done.returncode == 0, done.stdout
    assert not list(tmp_path.rglob(MARK))


def test_every_text_file_holds_printable_characters_only(made):
    """No control or format character reaches a file, where it could hide what it does or end a line."""
    seen = 0
    for folder in made.folders.values():
        for path in folder.rglob("*"):
            if path.suffix in (".c", ".h", ".m", ".md", ".py", ".xml", ".yaml", ".html", ".txt", ".json", ".cfg"):
                text, seen = path.read_text(encoding="utf-8"), seen + 1
                assert text.replace("\n", "").isprintable(), path
                assert ATTACK not in re.sub(r"/\*.*?\*/", "", text, flags=re.S) or path.suffix not in (".c", ".h"), path
    assert seen > 100


def test_python_files_parse_and_hold_no_text_of_the_author(made):
    for target in ("ros2", "casadi"):
        for path in made.folders[target].rglob("*.py"):
            ast.parse(path.read_text(encoding="utf-8"))
            assert "touch" not in path.read_text(encoding="utf-8")


def test_parameters_of_ros_are_read_back_and_name_every_input(made):
    folder = made.folders["ros2"]
    read = yaml.safe_load((folder / "config/params.yaml").read_text(encoding="utf-8"))
    sources = read["predictor"]["ros__parameters"]["sources"]
    about = json.loads((folder / "predictor_ros/model.json").read_text())
    names = [entry["name"] for entry in about["inputs"]]
    assert sources == [f"{name}=pressure:{name}" for name in names]
    assert len(set(names)) == len(names) == len(HOSTILE)
    assert all(name and name.isprintable() and len(name) <= 125 and "=" not in name for name in names)
    assert [entry.get("original", entry["name"]) for entry in about["inputs"]] == list(HOSTILE)
    assert not [name for name in names if name[0] in "=+-@"]


def test_the_core_of_the_ros_package_takes_its_own_parameters(made):
    place = made.folders["ros2"] / "predictor_ros/core.py"
    spec = importlib.util.spec_from_file_location("core_of_the_test", place)
    core = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(core)
    about = json.loads(made.text("ros2", "predictor_ros/model.json"))
    texts = yaml.safe_load(made.text("ros2", "config/params.yaml"))["predictor"]["ros__parameters"]["sources"]
    names = [entry["name"] for entry in about["inputs"]]
    assert list(core.read_sources(names, texts)) == names


def test_xml_is_well_formed_and_its_values_are_the_names(made):
    wanted = escape.shown_names([*HOSTILE])
    for version, element in ((2, "ScalarVariable"), (3, "Float64")):
        root = ET.fromstring(made.text(f"fmi{version}", "modelDescription.xml"))
        listed = [entry.attrib for entry in root.find("ModelVariables") if entry.tag == element or version == 2]
        inputs = [entry["name"] for entry in listed if entry["causality"] == "input"]
        assert inputs == wanted
        every = [entry.attrib["name"] for entry in root.find("ModelVariables")]
        assert len(set(every)) == len(every) >= len(HOSTILE) + len(OWN)
        told = {entry["name"]: entry.get("description") for entry in listed if entry["causality"] == "input"}
        assert told[wanted[0]] == HOSTILE[0]
    package = ET.fromstring(made.text("ros2", "package.xml"))
    assert package.find("name").text == "predictor_ros"


def test_strings_of_c_are_read_back(made, tmp_path):
    """What the compiler makes of the names is what the XML says."""
    if shutil.which("gcc") is None:
        pytest.skip("needs gcc")
    program = (
        '#include "fmu_model.h"\n#include <stdio.h>\nint main(void) { const char *const n[] = {FMU_INPUT_NAMES};\n'
    )
    program += "for (unsigned i = 0; i < FMU_INPUTS; i++) { (void)puts(n[i]); }\n"
    (tmp_path / "names.c").write_text(program + "return 0; }\n")
    where = made.folders["fmi2"] / "sources"
    done = subprocess.run(["gcc", "-I", where, "names.c", "-o", "names"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = subprocess.run([tmp_path / "names"], capture_output=True, check=True).stdout.decode()
    assert found.split("\n")[:-1] == escape.shown_names(HOSTILE)


def test_tables_of_markdown_hold_text_only(made):
    for target in ("ros2", "simulink"):
        tokens = MarkdownIt("commonmark").enable("table").parse(made.text(target, "README.md"))
        inline = [child for token in tokens for child in (token.children or [])]
        kinds = {child.type for child in inline}
        assert kinds <= {"text", "code_inline", "softbreak", "strong_open", "strong_close", "text_special"}, kinds
        assert not any(token.type in ("html_block", "heading_open") and token.level for token in tokens)
        assert not any(ATTACK in child.content for child in inline if child.type == "code_inline")
    rows = [row for row in made.text("simulink", "README.md").splitlines() if "| Pa |" in row]
    assert len(rows) == len(HOSTILE)
    assert all(len(re.findall(r"(?<!\\)\|", row)) == 5 for row in rows)


def test_the_page_of_an_fmu_has_no_element_of_the_author(made):
    page = made.text("fmi3", "documentation/index.html")
    assert set(re.findall(r"<(\w+)", page)) <= {
        "html", "head", "meta", "title", "body", "h1", "p", "ul", "li", "table", "tr", "th", "td",
    }  # fmt: skip
    assert "&lt;script&gt;" in page


def test_descriptions_in_json_and_mat_are_the_text_itself(made):
    for target, file in (("onnx", "predictor.json"), ("casadi", "predictor.json"), ("simulink", "predictor.json")):
        assert [entry["name"] for entry in json.loads(made.text(target, file))["inputs"]] == list(HOSTILE)
    for target in ("onnx", "simulink"):
        held = scipy.io.loadmat(made.folders[target] / "predictor.mat", simplify_cells=True)["edp"]["inputs"]
        assert len(held) == len(HOSTILE)
        assert held[0]["name"] == HOSTILE[0]
    fields = [entry["field"] for entry in json.loads(made.text("simulink", "predictor.json"))["inputs"]]
    assert len(set(fields)) == len(fields)
    assert all(re.fullmatch(r"[A-Za-z]\w{0,62}", field, re.ASCII) for field in fields)
    assert not set(fields) & (escape.MATLAB_WORDS | escape.C_WORDS)


def test_onnx_files_name_the_inputs_and_are_checked(made):
    onnx = pytest.importorskip("onnx", reason="needs the package onnx")
    model = onnx.load(made.folders["onnx"] / "predictor_step.onnx")
    onnx.checker.check_model(model)
    told = {entry.key: entry.value for entry in model.metadata_props}
    assert json.loads(told["inputs"]) == list(HOSTILE)


def test_matlab_code_is_read_by_octave_and_runs_nothing_of_the_author(made, tmp_path):
    if shutil.which("octave-cli") is None:
        pytest.skip("needs octave-cli")
    folder = made.folders["simulink"]
    program = f"addpath({escape.matlab_string(folder)}); net = predictor_load(); found = predictor_golden('native');\n"
    program += f"assert(numel(net.edp.inputs) == {len(HOSTILE)}); assert(found <= 1);\n"
    program += "r = struct(); for at = 1:numel(net.edp.inputs) r.(net.edp.inputs{at}.field) = (0:2)' * 0.01; end\n"
    program += "rows = predictor_rows(net, r); assert(size(rows, 1) == 3);\n"
    (tmp_path / "program_of_the_test.m").write_text(program)
    command = ["octave-cli", "--norc", "--quiet", "program_of_the_test.m"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert not list(tmp_path.rglob(MARK))


def test_identifiers_of_c_are_short_enough_and_all_different(made):
    header = made.text("c", "predictor.h")
    names = re.findall(r"^    (PREDICTOR_(?:IN|OUT)_\w+) = \d+,", header, re.MULTILINE)
    assert len(set(names)) == len(names) == len(HOSTILE) + 3
    assert max(map(len, names)) <= escape.C_SIGNIFICANT
    assert max(map(len, header.splitlines())) < 4095


def test_whole_numbers_carry_the_same_text(tmp_path):
    make_target("c").write(small(HOSTILE, whole=True), "predictor", tmp_path)
    compiled_and_loaded(tmp_path, [tmp_path / "predictor.c", *tmp_path.glob("edp_*.c")], "gcc")


@pytest.mark.parametrize("text", HOSTILE)
def test_every_function_of_a_language_gives_one_inert_line(text, tmp_path):
    comment = escape.c_comment(text)
    assert comment.isprintable()
    assert not re.search(r"\*/|/\*|\?\?|\\$", comment)
    assert yaml.safe_load(escape.yaml_scalar(text)) == text.replace("\ud800", "\ufffd")
    assert ast.literal_eval(escape.python_literal(text)) == text
    inside = escape.matlab_string(text)[1:-1]
    assert "'" not in inside.replace("''", "")
    assert (
        ET.fromstring(f'<a b="{escape.xml_text(text)}">{escape.xml_text(text)}</a>').text == escape.visible(text)
        or not text
    )
    literal = escape.c_string(text)
    assert re.fullmatch(r'"(?:[ -!#->@-\[\]-~]|\\[0-7]{3})*"', literal)
    assert ast.literal_eval(f"b{literal}") == text.encode("utf-8", "replace")


def test_a_template_takes_nothing_that_was_not_escaped():
    assert (
        escape.fill("${a} ${b} ${c}", {"a": 1, "b": "plain 1.0", "c": escape.c_comment("x*/y")}) == "1 plain 1.0 x* /y"
    )
    for text in ("x*/", 'a"', "a'b", "a\n", "a;b", "ä", "a\\", "$(x)", "<b>", "{x}", "a|b", "`a`", "a\0"):
        with pytest.raises(ExportError, match="not escaped"):
            escape.fill("/* ${title} */", {"title": text})


def test_every_template_is_filled_by_that_one_function():
    """A new emitter that fills templates by itself, or formats text of a bundle into code, is seen here."""
    room = Path(escape.__file__).parent
    for path in room.rglob("*.py"):
        if path.name != "escape.py" and "package" not in path.parts:
            tree = ast.parse(path.read_text(encoding="utf-8"))
            imported = {
                alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names
            }
            assert not imported & {"Template", "Formatter", "escape", "quoteattr"}, path
            for node in ast.walk(tree):
                if isinstance(node, ast.FormattedValue) and isinstance(node.value, ast.Attribute):
                    # Text of the author may be formatted into messages of errors only.
                    assert node.value.attr not in ("description", "descriptions", "unit", "provenance") or (
                        path.name == "text.py"
                        and node.value.attr in ("unit", "description")  # `enumeration` escapes it
                    ), f"{path}:{node.lineno}"


@pytest.mark.parametrize(
    "name", ["class", "int", "end", "string", "math", "host_test", "fuzz", "test", "edp_x", "a;b", "a\n", 'a"', "${x}"]
)
@pytest.mark.parametrize("target", list(TARGETS))
def test_names_of_the_model_that_a_target_cannot_carry_are_refused(target, name, tmp_path):
    if target == "onnx" and name.isidentifier():
        pytest.skip("a graph may be called that")
    with pytest.raises(ExportError, match="name"):
        make_target(target, QUICK.get(target)).write(small(HOSTILE[-4:]), name, tmp_path / "made")
    assert not list(tmp_path.iterdir())


def test_csv_of_the_replay_has_one_header_of_names(made):
    about = json.loads(made.text("ros2", "predictor_ros/model.json"))
    line = io.StringIO()
    csv.writer(line).writerow([target["name"] for target in about["targets"]])
    assert next(csv.reader(io.StringIO(line.getvalue()))) == [target["name"] for target in about["targets"]]
