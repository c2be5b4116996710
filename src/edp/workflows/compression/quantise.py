"""Conversion of a run to an integer (W8A16) run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from edp.config.experiment import experiment_toml
from edp.errors import ExportError
from edp.export.c.sizes import constant_bytes
from edp.networks.integer import integer_predictor
from edp.networks.running import mean_error
from edp.storage import check_writable, write_bytes, write_json
from edp.storage.paths import is_file_at
from edp.storage.runs import Run, check_claimable, run_key
from edp.training import save_bundle
from edp.training.bundle import weights_digest
from edp.workflows.train_evaluate import read_trained_run


def quantise(run: str | Path, out: str | Path, ticks: int = 20_000) -> dict[str, float]:
    """Write a run in W8A16; its evaluation, report and export use integer arithmetic.

    Formats and weights are chosen on the inputs of the training part; the errors are of the validation part.

    Args:
        run: run folder of a float network.
        out: folder of the new run.
        ticks: about how many ticks of the training part run through the whole network.

    Returns:
        ``float`` and ``integer``: MAE over horizons and targets in SI units; ``bytes``: of the constants of its C code.

    Raises:
        EdpError: not a run folder, a network without an integer form or already in integer form, or a folder that
            holds another run or cannot be written, which is seen before anything is computed.
    """
    check_claimable(out, "network")
    folder = Path(run)
    bundle, experiment, provenance, data = read_trained_run(folder)
    if bundle.predictor.number_format != "float32":
        raise ExportError(f"'{folder}' computes in {bundle.predictor.number_format} already; give the float run")
    check_writable(out)
    key = run_key({"quantised": ticks, "weights": weights_digest(bundle.predictor)}, data.digest)
    with Run.create(out, "network", key, experiment_toml(experiment)) as target:
        integer_network = integer_predictor(bundle.predictor, data.train, ticks)
        # Both errors on the validation part, so that the loss by rounding is not mixed with other data.
        errors = {
            name: mean_error(one, data.validation)
            for name, one in (("float", bundle.predictor), ("integer", integer_network))
        }
        for name in ("history.jsonl", "footprint.json"):
            if is_file_at(folder / name):
                write_bytes(target.file(name), (folder / name).read_bytes())
        provenance = provenance.add_entries(number_format=integer_network.number_format)
        write_json(target.file("provenance.json"), provenance.to_table())
        # Scores are those of the float network; they would be wrong for the integer one.
        save_bundle(replace(bundle, predictor=integer_network, scores={}), target.file("bundle"))
    return errors | {"bytes": float(constant_bytes(integer_network.integers, bundle.adaptation))}
