"""An FMU as a plant is a stranger's archive with native code in it: what is refused before anything is loaded."""

from __future__ import annotations

import io
import os
import stat
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from edp.control.fmu.archive import MAX_XML, MOST_ENTRIES, FmuArchive
from edp.control.fmu.description import MAX_ELEMENTS, MAX_VARIABLES, read_description
from edp.control.fmu.ports import ports_of
from edp.control.plants import plant_of
from edp.errors import ConfigError, DataError

PILOT = '<ScalarVariable name="BmUp" valueReference="0" causality="input"><Real unit="Pa" start="0"/></ScalarVariable>'
ANSWERS = [f"Cyl{kind}_{n}" for kind in ("Vels", "Stroke") for n in (1, 2, 3)]
UNITS = {"Vels": "m/s", "Stroke": "m"}


def answer(name: str, reference: int, unit: str | None = None) -> str:
    own = UNITS[name[3:].split("_")[0]] if unit is None else unit
    return (
        f'<ScalarVariable name="{name}" valueReference="{reference}" causality="output">'
        f'<Real unit="{own}"/></ScalarVariable>'
    )


VARIABLES = PILOT + "".join(answer(name, n) for n, name in enumerate(ANSWERS, start=1))


def described(
    variables: str = VARIABLES,
    head: str = 'fmiVersion="2.0" guid="{1}"',
    identifier: str = "plant",
    step: str = '<DefaultExperiment stepSize="0.01"/>',
    before: str = "",
    simulated: str = "",
) -> bytes:
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>{before}<fmiModelDescription {head} modelName="plant">'
        f'<CoSimulation modelIdentifier="{identifier}" {simulated}/>{step}'
        f"<ModelVariables>{variables}</ModelVariables></fmiModelDescription>"
    ).encode()


def reference(text: str) -> bytes:
    return described(variables=VARIABLES.replace('valueReference="3"', f'valueReference="{text}"'))


def packed(folder: Path, files: dict[str, bytes], name: str = "plant.fmu") -> Path:
    path = folder / name
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for entry, content in files.items():
            archive.writestr(entry, content)
    return path


def whole(folder: Path, xml: bytes | None = None, **more: bytes) -> Path:
    files = {"modelDescription.xml": described() if xml is None else xml}
    return packed(folder, files | {key.replace("__", "/"): content for key, content in more.items()})


def refused(path: Path) -> str:
    """The error of a plant that is trusted, whose folder holds nothing else afterwards."""
    before = set(path.parent.parent.rglob("*"))
    with pytest.raises((ConfigError, DataError)) as error:
        plant_of("M22", 1.0, 100.0, path, trusted=True)
    assert set(path.parent.parent.rglob("*")) == before
    text = str(error.value)
    assert len(text) < 800
    assert text.isprintable()
    return text


@pytest.mark.parametrize(
    "name",
    [
        "../evil.so", "binaries/../../evil.so", "/tmp/evil.so", "binaries/linux64/../../../evil", "C:\\evil.dll",
        "binaries\\linux64\\plant.so", "binaries//plant.so", "./plant.so", "a\nb", "resources/\x1b[2J",
    ],
)  # fmt: skip
def test_names_that_leave_the_folder_or_say_something_else_are_refused(tmp_path, name):
    path = packed(tmp_path, {"modelDescription.xml": described(), name: b"x"})
    assert "entry" in refused(path)


def test_links_are_refused(tmp_path):
    path = tmp_path / "plant.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", described())
        entry = zipfile.ZipInfo("binaries/linux64/plant.so")
        entry.create_system, entry.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
        archive.writestr(entry, "/etc/passwd")
    assert "is a link" in refused(path)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_entries_of_one_name_are_refused(tmp_path):
    path = tmp_path / "plant.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", described())
        archive.writestr("MODELDESCRIPTION.xml", b"<other/>")
    assert "twice" in refused(path)


def test_a_bomb_is_refused_by_what_it_would_unpack_to(tmp_path):
    # 600 MB of zeros in 600 kB: entries of 100 MB each.
    path = tmp_path / "plant.fmu"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", described())
        for n in range(6):
            with archive.open(f"resources/{n}", "w") as entry:
                for _ in range(100):
                    entry.write(bytes(1 << 20))
    assert path.stat().st_size < 2_000_000
    assert "unpack" in refused(path)


def test_sizes_that_the_directory_understates_do_not_unpack_more(tmp_path):
    path = packed(tmp_path, {"modelDescription.xml": described(), "resources/big": bytes(1 << 20)})
    raw = bytearray(path.read_bytes())
    at = raw.index(b"PK\x01\x02", raw.index(b"PK\x01\x02") + 4)
    raw[at + 24 : at + 28] = struct.pack("<I", 10)
    path.write_bytes(raw)
    with pytest.raises(DataError, match="damaged"):
        FmuArchive(path).unpack(tmp_path / "out", ("resources",))
    assert sum(file.stat().st_size for file in (tmp_path / "out").rglob("*") if file.is_file()) <= 10


def test_too_many_entries_are_refused(tmp_path):
    path = packed(tmp_path, {"modelDescription.xml": described()} | {f"r/{n}": b"" for n in range(MOST_ENTRIES)})
    assert f"{MOST_ENTRIES:,}" in refused(path)


def test_a_description_as_large_as_a_bomb_is_refused(tmp_path):
    assert "modelDescription.xml" in refused(whole(tmp_path, described(variables=" " * (MAX_XML + 1))))


@pytest.mark.parametrize(
    "content",
    [b"", b"PK\x03\x04", b"PK\x05\x06" + bytes(18), b"no archive", os.urandom(2000), b"PK\x05\x06" + b"\xff" * 40],
)
def test_what_is_no_archive_is_refused(tmp_path, content):
    path = tmp_path / "plant.fmu"
    path.write_bytes(content)
    refused(path)


def test_a_cut_archive_is_refused(tmp_path):
    path = whole(tmp_path, binaries__linux64__plant_so=os.urandom(5000))
    raw = path.read_bytes()
    for share in (0.1, 0.5, 0.9, 0.99):
        path.write_bytes(raw[: int(share * len(raw))])
        refused(path)


def test_what_is_no_file_is_refused(tmp_path):
    (tmp_path / "folder.fmu").mkdir()
    assert "no file" in refused(tmp_path / "folder.fmu")
    assert "no file" in refused(tmp_path / "absent.fmu")
    os.mkfifo(tmp_path / "pipe.fmu")
    assert "no file" in refused(tmp_path / "pipe.fmu")


def test_an_encrypted_archive_is_refused(tmp_path):
    path = whole(tmp_path)
    raw = bytearray(path.read_bytes())
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        raw[raw.index(signature) + offset] |= 1
    path.write_bytes(raw)
    assert "encrypted" in refused(path)


BOMB = "<!DOCTYPE b [" + "".join(f'<!ENTITY e{n} "{f"&e{n - 1};" * 10 if n else "x" * 100}">' for n in range(12)) + "]>"


@pytest.mark.parametrize(
    "before",
    [
        BOMB,
        '<!DOCTYPE b SYSTEM "file:///etc/passwd">',
        '<!DOCTYPE b [<!ENTITY x SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE b [<!ENTITY % x SYSTEM "http://127.0.0.1/x"> %x;]>',
        "<!DOCTYPE b>",
    ],
)
def test_document_types_and_with_them_entities_are_refused(tmp_path, before):
    xml = described(before=before).replace(b'modelName="plant"', b'modelName="&e11;"' if before is BOMB else b"a='1'")
    assert "document type" in refused(whole(tmp_path, xml))


@pytest.mark.parametrize(
    ("xml", "text"),
    [
        (b"", "not well-formed"),
        (b"<fmiModelDescription", "not well-formed"),
        (b"<html/>", "fmiModelDescription"),
        (b"<a>" * 5000, "deep"),
        (b'<?xml version="1.0" encoding="nonsense"?><a/>', "not well-formed"),
        (described(head='fmiVersion="1.0" guid="{1}"'), "1.0"),
        (described(head='fmiVersion="2.0"'), "guid"),
        (described(identifier="../../evil"), "modelIdentifier"),
        (described(identifier=""), "modelIdentifier"),
        (described(identifier="a" * 1000), "modelIdentifier"),
        (described().replace(b"CoSimulation", b"ModelExchange"), "co-simulation"),
        (described(simulated='needsExecutionTool="true"'), "needs a tool"),
        (described(variables=VARIABLES + answer("CylVels_1", 40)), "twice"),
        (reference("minus"), "valueReference"),
        (reference("-1"), "valueReference"),
        (reference("99999999999"), "valueReference"),
        (reference("9" * 6000), "valueReference"),
        (described(step='<DefaultExperiment stepSize="nan"/>'), "stepSize"),
        (described(step='<DefaultExperiment stepSize="1e999"/>'), "stepSize"),
        (described(step='<DefaultExperiment stepSize="-0.01"/>'), "stepSize"),
    ],
)  # fmt: skip
def test_descriptions_that_are_wrong_are_refused(tmp_path, xml, text):
    assert text in refused(whole(tmp_path, xml))


def test_too_many_variables_are_refused():
    xml = described(variables=PILOT * (MAX_VARIABLES + 1))
    with pytest.raises(DataError, match="variables"):
        read_description(xml, "a test")


@pytest.mark.parametrize(
    ("variables", "text"),
    [
        (VARIABLES.replace('name="CylVels_2"', 'name="Other"'), "has no CylVels_2"),
        (VARIABLES.replace('name="CylStroke_3"', 'name="CylStrok_3"'), "has no CylStroke_3"),
        (VARIABLES.replace('name="BmUp"', 'name="BmUpp"'), "BmUp"),
        (VARIABLES.replace('unit="Pa"', 'unit="bar"'), "'BmUp' is in bar; expected Pa"),
        (VARIABLES.replace('unit="m/s"', 'unit="mm/s"', 1), "'CylVels_1' is in mm/s; expected m/s"),
        (VARIABLES.replace("<Real", "<Integer"), "real"),
    ],
)
def test_other_variables_and_units_are_refused(tmp_path, variables, text):
    assert text in refused(whole(tmp_path, described(variables=variables)))


def test_names_of_an_author_cannot_reach_the_terminal_as_controls(tmp_path):
    odd = VARIABLES.replace('name="BmUp"', 'name="Bm&#27;[2JUp&#10;"'.replace("&#27;", "&#133;"))
    refused(whole(tmp_path, described(variables=odd)))
    refused(whole(tmp_path, described(variables=VARIABLES.replace('unit="Pa"', 'unit="&#133;[2J' + "y" * 500 + '"'))))


def test_another_rate_is_refused(tmp_path):
    text = refused(whole(tmp_path, described(step='<DefaultExperiment stepSize="0.02"/>')))
    assert "50 Hz" in text
    assert "100 Hz" in text


def test_without_a_library_for_this_computer_it_is_refused(tmp_path):
    text = refused(packed(tmp_path, {"modelDescription.xml": described(), "binaries/win64/plant.dll": b"MZ"}))
    assert "win64" in text
    assert "no library" in text


def test_a_library_that_is_none_is_one_error_and_the_working_folder_stays(tmp_path):
    fmpy = pytest.importorskip("fmpy")
    where = os.getcwd()
    text = refused(packed(tmp_path, {
        "modelDescription.xml": described(), f"binaries/{fmpy.platform}/plant{fmpy.sharedLibraryExtension}": b"no ELF",
    }))  # fmt: skip
    assert "load" in text
    assert os.getcwd() == where


def test_nothing_is_read_without_trust(tmp_path):
    path = tmp_path / "plant.fmu"
    path.write_bytes(b"no archive")
    with pytest.raises(ConfigError, match=r"native code.*trusted"):
        plant_of("M22", 1.0, 100.0, path)


@pytest.mark.parametrize("command", ["control", "tune"])
def test_the_commands_ask_first(edp, tmp_path, command):
    path = tmp_path / "plant.fmu"
    path.write_bytes(b"no archive")
    option = "--plant" if command == "control" else "--on"
    ended = edp(command, tmp_path / "run", option, path)
    assert ended.code == 1
    assert "--yes" in ended.said
    assert "nothing was run" in ended.said
    assert not (tmp_path / "run").exists()
    ended = edp(command, tmp_path / "run", option, path, "--yes")
    assert "is not a ZIP archive" in ended.said
    assert ended.code == 1


def test_the_archive_reads_what_it_says(tmp_path):
    path = whole(tmp_path, resources__a=b"1", binaries__linux64__plant_so=b"2")
    archive = FmuArchive(path)
    assert archive.description() == described()
    assert archive.under("resources") == ["resources/a"]
    archive.unpack(tmp_path / "out", ("resources",))
    assert (tmp_path / "out/resources/a").read_bytes() == b"1"
    assert not (tmp_path / "out/binaries").exists()
    assert io.BytesIO(path.read_bytes()).getvalue()[:2] == b"PK"


@pytest.mark.parametrize("seed", range(4))
def test_damage_anywhere_ends_in_one_of_our_errors_or_in_a_sound_description(tmp_path, seed):
    rng, texts = np.random.default_rng(seed), []
    sound = whole(tmp_path, resources__a=b"1" * 100, binaries__linux64__plant_so=b"2" * 100).read_bytes()
    path = tmp_path / "damaged.fmu"
    for _ in range(60):
        raw = bytearray(sound)
        for at in rng.integers(0, len(raw), rng.integers(1, 8)):
            raw[at] = rng.integers(256)
        path.write_bytes(raw)
        try:
            archive = FmuArchive(path)
            ports_of(read_description(archive.description(), "a test"), "a test")
            archive.unpack(tmp_path / "out", ("resources", "binaries"))
        except (ConfigError, DataError) as error:
            texts.append(str(error))
    xml = described()
    for _ in range(200):
        raw = bytearray(xml)
        for at in rng.integers(0, len(raw), rng.integers(1, 5)):
            raw[at] = rng.integers(256)
        try:
            ports_of(read_description(bytes(raw), "a test"), "a test")
        except (ConfigError, DataError) as error:
            texts.append(str(error))
    assert texts
    assert all(text.isprintable() for text in texts)


def test_a_description_of_elements_without_end_is_refused():
    with pytest.raises(DataError, match="elements"):
        read_description(b"<a>" + b"<b/>" * (MAX_ELEMENTS + 1) + b"</a>", "a test")
