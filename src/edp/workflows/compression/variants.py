"""The compressed variants of the thesis by name (Table 4.9), and ours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from edp.networks.matrices import matrices_of
from edp.networks.narrow import width_of
from edp.networks.predictor import Predictor
from edp.registry import Registry
from edp.training.compression.qat import RoundingSpec
from edp.workflows.compression.bench import Bench, CompressionRequest

THESIS = RoundingSpec(activation_bits=8, recurrent=False)
"""What fake quantisation of the thesis covers: convolutions and linear layers, 8 bits."""


@dataclass(frozen=True, eq=False)
class CompressedCandidate:
    """A smaller network and the numbers it is to run with.

    Attributes:
        name: of the variant.
        order: what made it.
        network: in float32; it can be saved and exported.
        number_format: a name of `edp.workflows.compression.formats.FORMATS`; it is judged in it.
        parameter_bytes: as Table 4.9 counts them; None where the format says it.
    """

    name: str
    order: CompressionRequest
    network: Predictor
    number_format: str = "float32"
    parameter_bytes: int | None = None


Variant = Callable[[Bench], CompressedCandidate]
VARIANTS: Registry[Variant] = Registry("variant")


def rounded_order(of: CompressionRequest) -> CompressionRequest:
    """The order to train on what another one made, with everything rounded."""
    return CompressionRequest(name=f"{of.name}_qat", units=of.units, rounding=RoundingSpec(), of=of)


def _distilled(units: int) -> CompressionRequest:
    return CompressionRequest(name=f"u{units}", units=units)


def _rounded(bench: Bench, name: str, of: CompressionRequest | None) -> CompressedCandidate:
    units = width_of(bench.teacher.spec) if of is None else of.units
    begun = "teacher" if of is None else of.name
    order = CompressionRequest(name=f"{begun}_thesis_qat", units=units, rounding=THESIS, of=of)
    network = bench.network(order)
    folded = sum(cost.parameters - cost.foldable for cost in network.costs())
    rounded = sum(matrix.values.numel() for matrix in matrices_of(network, recurrent=False))
    # Bytes as the thesis counts them: one for each rounded weight, four for the others.
    return CompressedCandidate(name, order, network, "dynamic_int8", 4 * folded - 3 * rounded)


@VARIANTS.register("A_u32")
def a_u32(bench: Bench) -> CompressedCandidate:
    """A distilled student of 32 units."""
    return CompressedCandidate("A_u32", _distilled(32), bench.network(_distilled(32)))


@VARIANTS.register("A_u64")
def a_u64(bench: Bench) -> CompressedCandidate:
    """A distilled student of 64 units."""
    return CompressedCandidate("A_u64", _distilled(64), bench.network(_distilled(64)))


@VARIANTS.register("B_LPTQ")
def b_lptq(bench: Bench) -> CompressedCandidate:
    """The student of 64 units with its linear layers in dynamic INT8, not trained again."""
    return CompressedCandidate("B_LPTQ", _distilled(64), bench.network(_distilled(64)), "dynamic_int8")


@VARIANTS.register("C_QAT")
def c_qat(bench: Bench) -> CompressedCandidate:
    """The teacher, trained on under its own guidance with rounded convolutions and linear layers."""
    return _rounded(bench, "C_QAT", None)


@VARIANTS.register("C_u64_QAT")
def c_u64_qat(bench: Bench) -> CompressedCandidate:
    """The student of 64 units, trained on with rounded convolutions and linear layers."""
    return _rounded(bench, "C_u64_QAT", _distilled(64))


def _ours(bench: Bench, units: int) -> CompressedCandidate:
    order = rounded_order(CompressionRequest(name=f"p{units}", units=units, pruned=True))
    return CompressedCandidate(f"D_u{units}", order, bench.network(order), "w8a16")


@VARIANTS.register("D_u32")
def d_u32(bench: Bench) -> CompressedCandidate:
    """Ours: the teacher pruned to 32 units, distilled, trained on with everything rounded, in W8A16."""
    return _ours(bench, 32)


@VARIANTS.register("D_u64")
def d_u64(bench: Bench) -> CompressedCandidate:
    """Ours: the teacher pruned to 64 units, distilled, trained on with everything rounded, in W8A16."""
    return _ours(bench, 64)
