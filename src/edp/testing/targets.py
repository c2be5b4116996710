"""Contract of an export target: it writes each network, or refuses it with a reason and leaves no files."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

from edp.errors import ExportError
from edp.export import TARGETS, make_target
from edp.networks.blocks import BLOCKS
from edp.networks.heads import MlpHead
from edp.networks.outputs import OUTPUTS
from edp.networks.predictor import ModelSpec, Predictor
from edp.signals import TABLE_A1, Channel, Kind
from edp.testing.expectations import expect
from edp.testing.networks import SMALL_BACKBONES, WINDOW, small_network, small_task
from edp.training.bundle import Bundle

# Empty, upper case, a digit first, a space, too long, a path out of the folder.
WRONG_NAMES = ("", "Upper", "2nd", "with space", "a" * 60, "../up")
Options = Mapping[str, object] | None


def bundle_around(predictor: Predictor) -> Bundle:
    """Return a bundle of a network with channels from the vocabulary or generic ones."""
    task = predictor.task
    inputs = tuple(TABLE_A1.get(name) or Channel(name, Kind.GENERIC, "an input") for name in task.inputs)
    return Bundle(predictor, inputs, (Kind.GENERIC,) * len(task.targets), task.targets)


def check_written(target: str, bundle: Bundle, folder: Path, options: Options = None) -> None:
    """Check that a target writes a bundle: existing files in the folder, the first one not empty.

    Raises:
        ContractError: it does not.
        ExportError: it refuses the network.
    """
    files = make_target(target, options).write(bundle, "predictor", folder)
    expect(bool(files), f"export target '{target}' names no files")
    absent = [path.name for path in files if not path.is_file()]
    expect(not absent, f"export target '{target}' names files that it did not write: {', '.join(absent)}")
    expect(files[0].stat().st_size > 0, f"export target '{target}': '{files[0].name}', to be read first, is empty")
    outside = [path.name for path in files if folder not in path.parents]
    expect(not outside, f"export target '{target}' writes outside its folder: {', '.join(outside)}")


def refusal_of(target: str, bundle: Bundle, folder: Path, options: Options = None) -> str:
    """Return the reason why a target refuses a bundle; empty if it writes the bundle.

    Raises:
        ContractError: it writes something else than it says, or leaves something behind a refusal.
    """
    try:
        check_written(target, bundle, folder, options)
    except ExportError as error:
        expect(bool(str(error)), f"export target '{target}' refuses a network without a reason")
        # A refusal that leaves files would look like half an export.
        expect(not list(folder.rglob("*.*")), f"export target '{target}' leaves files behind a refusal")
        return str(error)
    return ""


def check_names_refused(target: str, bundle: Bundle, folder: Path, options: Options = None) -> None:
    """Check that invalid program names are refused before a file is written.

    Raises:
        ContractError: one is taken, or something is left behind.
    """
    for name in WRONG_NAMES:
        try:
            make_target(target, options).write(bundle, name, folder)
        except ExportError as error:
            expect(
                "name" in str(error), f"export target '{target}' refuses the name {name!r} for another reason: {error}"
            )
        else:
            expect(False, f"export target '{target}' takes the name {name!r}")
        expect(not list(folder.rglob("*.*")), f"export target '{target}' writes something for the name {name!r}")


def check_export_target(target: type, **options: object) -> None:
    """Check the contract of an export target on four small networks.

    Args:
        target: a class entered with ``@TARGETS.register("name")``.
        options: options of the target.

    Raises:
        ConfigError: it is not registered, or has no such option.
        ContractError: a contract is broken; the message says which and how.
    """
    name = TARGETS.name_of(target)
    # Four networks: recurrent, convolutional, with intervals, with blocks. No target need take all of them.
    plain = ModelSpec(backbone=SMALL_BACKBONES["lstm"], head=MlpHead(hidden=6), window=WINDOW)
    models = [
        plain,
        ModelSpec(backbone=SMALL_BACKBONES["tcn"], head=MlpHead(hidden=6), window=WINDOW),
        ModelSpec(
            backbone=SMALL_BACKBONES["gru"], head=MlpHead(hidden=6), output=OUTPUTS["quantiles"](), window=WINDOW
        ),
        ModelSpec(
            backbone=SMALL_BACKBONES["hybrid"],
            head=MlpHead(hidden=6),
            blocks=(BLOCKS["temporal_difference"](), BLOCKS["cylinder_gate"]()),
            window=WINDOW,
        ),
    ]
    reasons = []
    with tempfile.TemporaryDirectory(prefix="edp-target-") as folder:
        for number, model in enumerate(models):
            bundle = bundle_around(small_network(model, small_task(model)))
            reasons.append(refusal_of(name, bundle, Path(folder) / f"network_{number}", options))
        expect("" in reasons, f"export target '{name}' refuses every network: {'; '.join(dict.fromkeys(reasons))}")
        bundle = bundle_around(small_network(plain, small_task(plain)))
        check_names_refused(name, bundle, Path(folder) / "names", options)
