"""The predictor: front end, backbone, heads and activation as one causal network in SI units."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from edp.data.scaling import Scaler
from edp.data.task import Task
from edp.errors import ConfigError, ExportError
from edp.ir import Builder, Graph
from edp.ir.base import INPUT
from edp.ir.layers import BinaryOperation, ScaleShift
from edp.networks.activations import ACTIVATIONS, ActivationSpec, Identity
from edp.networks.backbones import BACKBONES, BackboneSpec, HybridSpec, select_slot
from edp.networks.blocks.base import BLOCKS, OUTPUT_SLOTS, SHARED_SLOTS, BlockSlot, HasConflicts, OutputSpace
from edp.networks.frontend import FrontEnd, TargetTransform
from edp.networks.heads import HEADS, HeadSpec, MlpHead
from edp.networks.losses import Prediction
from edp.networks.outputs import OUTPUTS, OutputSpec, Point
from edp.networks.physics import PHYSICS, PhysicsBase, PhysicsSpec
from edp.networks.size import MAX_STATE, MOST_PARAMETERS, size_at_most
from edp.networks.streaming import Cost, State, Streaming, parameters_of, state_numbers
from edp.settings.bounds import MOST_TICKS, check_bounds, check_count, integer


@dataclass(frozen=True, kw_only=True)
class ModelSpec:
    """The network: a backbone, heads, an output activation and an ordered tuple of blocks.

    Attributes:
        backbone: options of a registered backbone.
        head: options of registered per-output heads.
        activation: options of a registered output activation.
        output: options of a registered output: point, quantiles or an error distribution per target.
        blocks: options of registered blocks; absent means not built.
        window: W, samples of trailing context of pooling, and the length of the window regime.
        physics: options of a registered physics base; None for no base.
    """

    backbone: BackboneSpec = field(default_factory=HybridSpec)
    head: HeadSpec = field(default_factory=MlpHead)
    activation: ActivationSpec = field(default_factory=Identity)
    output: OutputSpec = field(default_factory=Point)
    blocks: tuple[object, ...] = ()
    window: int = 50
    physics: PhysicsSpec | None = None

    def __post_init__(self) -> None:
        check_bounds("model", self, window=integer(1, MOST_TICKS))
        check_count("model", "blocks", self.blocks, len(BLOCKS))
        offered = {*self.backbone.slots(), *OUTPUT_SLOTS}
        for block in self.blocks:
            slot = getattr(block, "slot", None)
            if slot not in offered:
                raise ConfigError(
                    f"block '{BLOCKS.name_of(block)}' needs the slot '{slot}', which this backbone does not offer "
                    f"(it has {', '.join(sorted(offered))}); remove the block or choose another backbone"
                )
        for block_slot in BlockSlot:
            names = [BLOCKS.name_of(block) for block in select_slot(self.blocks, block_slot)]
            if len(names) > 1 and (block_slot not in SHARED_SLOTS or len(set(names)) < len(names)):
                raise ConfigError(f"blocks {', '.join(names)} share the slot '{block_slot}'; keep one of them")


def check_combination(task: Task, spec: ModelSpec) -> None:
    """Refuse parts that contradict the task or one another.

    Raises:
        ConfigError: the reason that each of them gives.
    """
    parts = (spec.backbone, spec.head, spec.output, spec.activation, *spec.blocks, spec.physics)
    reasons = [part.conflicts(spec, task) for part in parts if isinstance(part, HasConflicts)]
    stated_reasons = [reason for reason in reasons if reason]
    if stated_reasons:
        raise ConfigError("; ".join(stated_reasons))


class Predictor(Streaming):
    """A look-ahead predictor (eq. 3.6) that reads and writes SI units.

    ``forward`` maps inputs ``(batch, time, input)`` to standardised predictions ``(batch, time, horizon, target)``;
    ``predict`` gives them in SI units. Both obey the streaming contract. For outputs with an uncertainty, ``intervals``
    returns lower and upper bounds.

    Attributes:
        number_format: number format of the computation; bundles contain float32 only.
    """

    number_format = "float32"

    def __init__(self, task: Task, spec: ModelSpec, scaler: Scaler) -> None:
        super().__init__()
        # Contradictions are refused before the size is computed: the message about the cause comes first.
        check_combination(task, spec)
        _check_size(task, spec, scaler)
        self.task, self.spec = task, spec
        features, outputs, horizons = len(task.features.features), len(task.targets), len(task.horizons)
        self.front = FrontEnd(task, scaler)
        self.code = TargetTransform(task, scaler)
        self.backbone, width = spec.backbone.build(features, spec.window, spec.blocks, horizons * outputs)
        self.gate = self._block(BlockSlot.GATE, width, outputs)
        mix = self._block(BlockSlot.MIX, spec.head.hidden, outputs)
        self.heads = spec.head.build(width, outputs, horizons * spec.output.values, mix)
        self.output = spec.output.build(horizons, outputs)
        self.activation = spec.activation.build(outputs)
        self.bypass = self._block(
            BlockSlot.BYPASS, OutputSpace(features, horizons, outputs, task.present, *self._present())
        )
        self.physics: PhysicsBase | None = spec.physics.build(task) if spec.physics is not None else None

    def _block(self, slot: BlockSlot, *sizes: object) -> Streaming | None:
        """Build the block in a slot with a single block; None if the slot is empty."""
        slot_blocks = select_slot(self.spec.blocks, slot)
        return slot_blocks[0].build(*sizes) if slot_blocks else None  # type: ignore[attr-defined]

    def _present(self) -> tuple[Tensor, Tensor]:
        """Return the gain and shift, ``(horizon, target)``, from scaled features to present values in target space."""
        # A target without a feature takes any column; blocks that read present values refuse that case.
        columns = [column or 0 for column in self.task.present]
        gain = self.front.width[columns] / self.code.width
        return gain, (self.front.offset[columns] - self.code.offset) / self.code.width

    def _parts(self) -> dict[str, Streaming]:
        parts = {"backbone": self.backbone, "gate": self.gate, "heads": self.heads, "bypass": self.bypass}
        parts["physics"] = self.physics
        return {name: part for name, part in parts.items() if part is not None}

    @property
    def title(self) -> str:
        """A line about the network, for tables and exported files."""
        return describe(self.spec)

    @property
    def window(self) -> int:
        """Number of samples after a reset until a prediction uses the full memory of the network."""
        return self.spec.window

    @property
    def required(self) -> int:
        """How many of the inputs, the first ones, a program must feed; the others may stay at zero."""
        return len(self.task.inputs)

    def initial_state(self, batch: int, like: Tensor) -> State:
        """State at reset for `batch` streams."""
        state = {"front": self.front.initial_state(batch, like)}
        return state | {name: part.initial_state(batch, like) for name, part in self._parts().items()}

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Return the standardised predictions ``(batch, time, horizon, target)`` and the next state."""
        answer, _, new = self.run(x, state)
        return answer.center, new

    def run(self, x: Tensor, state: State) -> tuple[Prediction, Tensor, State]:
        """Return the standardised output, the physical features ``(batch, time, feature)``, and the next state."""
        answer, features, _, new = self.forward_features(x, state)
        return answer, features, new

    def forward_features(self, x: Tensor, state: State) -> tuple[Prediction, Tensor, Tensor, State]:
        """Return the results of `run` with the backbone's representation ``(batch, time, width)`` before the state."""
        new: dict[str, State] = {}
        features, new["front"] = self.front(x, state["front"])
        scaled = self.front.scale(features)
        hidden, new["backbone"] = self.backbone(scaled, state["backbone"])
        y = hidden
        if self.gate is not None:
            y, new["gate"] = self.gate(y, state["gate"])
        y, new["heads"] = self.heads(y, state["heads"])
        values = y.unflatten(-2, (len(self.task.horizons), self.spec.output.values))
        # Activation and skip connection act on the prediction; the spread is counted from where they leave it.
        center = self.activation(values[..., 0, :])
        if self.bypass is not None:
            direct, new["bypass"] = self.bypass(scaled, state["bypass"])
            center = center + direct
        if self.physics is not None:
            # Outside g, so that the bound of g limits the correction and not the physics.
            ahead, new["physics"] = self.physics(x, state["physics"])
            center = center + self.physics.is_velocity * self.code.encode(ahead, features)
        return self.output.answer(center, values[..., 1:, :]), features, hidden, new

    def predict(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Return the predictions in SI units, ``(batch, time, horizon, target)``, and the next state."""
        answer, features, new = self.run(x, state)
        return self.code.decode(answer.center, features), new

    def intervals(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Return the bounds in SI units ``(batch, time, coverage, 2, horizon, target)``, lower then upper.

        And the next state.

        The coverages are those of ``spec.output.coverages``, in their order.
        """
        answer, features, new = self.run(x, state)
        return self._bounds(answer, features), new

    def predict_with_intervals(self, x: Tensor, state: State) -> tuple[Tensor, Tensor | None, State]:
        """Return the results of `predict` and `intervals` from one pass.

        Bounds are None for outputs without intervals.
        """
        answer, features, new = self.run(x, state)
        bounds = self._bounds(answer, features) if self.output.coverages else None
        return self.code.decode(answer.center, features), bounds, new

    def _bounds(self, answer: Prediction, features: Tensor) -> Tensor:
        """Return the bounds in SI units ``(batch, time, coverage, 2, horizon, target)``."""
        bounds = [
            torch.stack([self.code.decode(bound, features) for bound in self.output.interval(answer, which)], dim=2)
            for which in range(len(self.output.coverages))
        ]
        return torch.stack(bounds, dim=2)

    def lower(self, build: Builder, x: str) -> str:
        """Add the predictions in SI units, ``horizon * target`` elements."""
        return self._lower(build, x)["prediction"]

    def graph(self) -> Graph:
        """Return the network as a graph of streaming layers with float32 constants, from SI inputs to SI predictions.

        Raises:
            ExportError: a part of it has no such form; it is named. Or it computes with other numbers than float32.
        """
        # Rounded networks have graphs of their own; a float list of them would compute something else.
        if self.number_format != "float32":
            raise ExportError(f"a network in {self.number_format} has no list of float32 layers; take the float one")
        with torch.no_grad():
            build = Builder(len(self.task.inputs))
            return build.graph(self._lower(build, INPUT), self.spec.window)

    def _lower(self, build: Builder, x: str) -> dict[str, str]:
        with build.inside("front"):
            # Physical features serve two readers: scaling, and the present values of delta mode.
            features = self.front.lower(build, x)
            base = self.code.lower_base(build, features)
            scaled = self.front.lower_scale(build, features)
        with build.inside("backbone"):
            y = self.backbone.lower(build, scaled)
        with build.inside("heads"):
            y = self.heads.lower(build, y if self.gate is None else self.gate.lower(build, y))
        with build.inside("output"):
            center = self._lower_center(build, x, scaled, base, y)
            bounds = self.output.lower(build, center, y)
        results = {"prediction": self.code.lower_decode(build, "prediction", center, base)}
        for name, bound in zip(("lower", "upper"), bounds or (), strict=False):
            results[name] = self.code.lower_decode(build, name, bound, base)
        return results

    def _lower_center(self, build: Builder, x: str, scaled: str, base: str | None, y: str) -> str:
        """Add the standardised prediction, ``horizon * target``."""
        horizons, outputs, values = len(self.task.horizons), len(self.task.targets), self.spec.output.values
        # Of each horizon only the first value is the prediction; the others state its uncertainty.
        first = [(h * values) * outputs + c for h in range(horizons) for c in range(outputs)]
        act = getattr(self.activation, "lower", None)
        if act is None:
            name = ACTIVATIONS.name_of(self.spec.activation)
            raise ExportError(f"activation '{name}' has no form as a layer; give its module a method `lower`")
        center: str = act(build, build.pick("center", y, first))
        if self.bypass is not None:
            direct = self.bypass.lower(build, scaled)
            center = build.combine("with_bypass", BinaryOperation.ADD, center, direct)
        if self.physics is not None:
            ahead = self.code.lower_encode(build, self.physics.lower(build, x), base)
            is_velocity = self.physics.is_velocity.repeat(horizons)
            ahead = build.add(ScaleShift, "known", ahead, gain=is_velocity, shift=torch.zeros_like(is_velocity))
            center = build.combine("with_physics", BinaryOperation.ADD, center, ahead)
        return center

    def costs(self) -> list[Cost]:
        """Return analytic costs of every part."""
        rows = self.front.costs()
        for part in self._parts().values():
            rows += part.costs()
        amplitudes = parameters_of(self.activation)
        if amplitudes:
            rows.append(
                Cost("output amplitudes", amplitudes, foldable=amplitudes, width_out=amplitudes, per_time_step=False)
            )
        return rows


def _check_size(task: Task, spec: ModelSpec, scaler: Scaler) -> None:
    """Refuse a network that is too large before any of it is there.

    Raises:
        ConfigError: more parameters or numbers of state than `edp.networks.size` allows.
    """
    parameters, state = size_at_most(spec, task)
    # On the meta device nothing is allocated, and the check itself builds such a network.
    if (parameters <= MOST_PARAMETERS and state <= MAX_STATE) or torch.get_default_device().type == "meta":
        return
    with torch.device("meta"), torch.random.fork_rng(devices=[]):  # shapes without numbers; takes seconds to load
        net = Predictor(task, replace(spec, physics=None), scaler)
        parameters = sum(tensor.numel() for tensor in net.state_dict().values())  # tables of trees included
        state = state_numbers(net.initial_state(1, torch.zeros(())))
    if parameters > MOST_PARAMETERS or state > MAX_STATE:
        raise ConfigError(
            f"model: the network would have {parameters:,} parameters and carry {state:,} numbers from tick to tick; "
            f"at most {MOST_PARAMETERS:,} and {MAX_STATE:,} must hold: make backbone.channels, backbone.units, "
            "backbone.kernel, the head, the window or the number of horizons smaller"
        )


def build_model(task: Task, spec: ModelSpec, scaler: Scaler, seed: int) -> Predictor:
    """Build a predictor with random initial weights; equal seeds give equal weights."""
    # The caller's generator stays as it is: building a network must not change what is drawn after it.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        predictor = Predictor(task, spec, scaler)
    if predictor.physics is not None:
        predictor.physics.read()
    return predictor


def trainable(module: nn.Module) -> list[nn.Parameter]:
    """Return the parameters that training changes."""
    return [parameter for parameter in module.parameters() if parameter.requires_grad]


def describe(spec: ModelSpec) -> str:
    """Return a short label for tables, for example ``hybrid + temporal_difference``.

    Default heads and outputs are omitted.
    """
    physics = [] if spec.physics is None else [f"{PHYSICS.name_of(spec.physics)} physics"]
    ends = [
        f"{registry.name_of(part)} {what}"
        for registry, part, what, plain in (
            (HEADS, spec.head, "head", MlpHead),
            (ACTIVATIONS, spec.activation, "activation", Identity),
            (OUTPUTS, spec.output, "output", Point),
        )
        if not isinstance(part, plain)
    ]
    blocks = [BLOCKS.name_of(block) for block in spec.blocks]
    return " + ".join([BACKBONES.name_of(spec.backbone), *blocks, *ends, *physics])
