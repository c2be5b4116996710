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
"""Fake quantisation of the thesis: convolutions and linear layers with 8 bits."""


@dataclass(frozen=True, eq=False)
class CompressedCandidate:
    """Smaller network with its number format.

    Attributes:
        name: name of the variant.
        order: request that produced it.
        network: network in float32, which can be saved and exported.
        number_format: a name of `edp.workflows.compression.FORMATS`; it is evaluated in it.
        parameter_bytes: size as in Table 4.9; None to use the size in the format.
    """

    name: str
    order: CompressionRequest
    network: Predictor
    number_format: str = "float32"
    parameter_bytes: int | None = None


VARIANTS: Registry[Callable[[Bench], CompressedCandidate]] = Registry("variant")


def make_rounded_request(of: CompressionRequest) -> CompressionRequest:
    """Return the order to train on what another one made, with everything rounded."""
    return CompressionRequest(name=f"{of.name}_qat", units=of.units, rounding=RoundingSpec(), of=of)


@dataclass(frozen=True)
class MadeByOrder:
    """A variant whose network an order makes."""

    name: str
    order: CompressionRequest
    number_format: str = "float32"

    def __call__(self, bench: Bench) -> CompressedCandidate:
        """Make the candidate; earlier trainings are reused."""
        return CompressedCandidate(self.name, self.order, bench.network(self.order), self.number_format)


@dataclass(frozen=True)
class RoundedLikeThesis:
    """Variant fine-tuned with rounded convolutions and linear layers: a request's network, or the teacher."""

    name: str
    order: CompressionRequest | None

    def __call__(self, bench: Bench) -> CompressedCandidate:
        """Make the candidate; earlier trainings are reused."""
        units = width_of(bench.teacher.spec) if self.order is None else self.order.units
        begun = "teacher" if self.order is None else self.order.name
        order = CompressionRequest(name=f"{begun}_thesis_qat", units=units, rounding=THESIS, of=self.order)
        network = bench.network(order)
        folded = sum(cost.parameters - cost.foldable for cost in network.costs())
        rounded = sum(matrix.values.numel() for matrix in matrices_of(network, recurrent=False))
        # Bytes as the thesis counts them: one for each rounded weight, four for the others.
        return CompressedCandidate(self.name, order, network, "dynamic_int8", 4 * folded - 3 * rounded)


U32, U64 = (CompressionRequest(name=f"u{units}", units=units) for units in (32, 64))
P32, P64 = (CompressionRequest(name=f"p{units}", units=units, pruned=True) for units in (32, 64))
# A: distilled. B: with linear layers in dynamic INT8, not trained again. C: trained on with rounded numbers.
# D, ours: pruned, distilled, trained on with everything rounded, in W8A16.
for variant in (
    MadeByOrder("A_u32", U32),
    MadeByOrder("A_u64", U64),
    MadeByOrder("B_LPTQ", U64, "dynamic_int8"),
    RoundedLikeThesis("C_QAT", None),
    RoundedLikeThesis("C_u64_QAT", U64),
    MadeByOrder("D_u32", make_rounded_request(P32), "w8a16"),
    MadeByOrder("D_u64", make_rounded_request(P64), "w8a16"),
):
    VARIANTS.register(variant.name)(variant)
