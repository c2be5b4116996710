"""Recurrent layers: against plain loops over their equations, gradients, splits into chunks, zoneout, refusals."""

import pytest
import torch

from edp.errors import ConfigError
from edp.networks.backbones import GruSpec, HybridSpec, LstmSpec
from edp.networks.cells import CELLS
from edp.networks.cells.scan import linear_scan
from edp.networks.streaming import map_state, parameters_of

KINDS = [(name, rate) for name in CELLS for rate in ((0.0, 0.3) if CELLS[name].zoneout else (0.0,))]


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(6)


@pytest.fixture(params=KINDS, ids=lambda kind: f"{kind[0]}-{kind[1]}")
def kind(request):
    return request.param


def make(kind, width=3, units=4, dtype=torch.float64):
    options = {"states": units} if kind[0] == "diagonal_ssm" else {}
    layer = CELLS[kind[0]](**options).build(width, units, kind[1]).to(dtype).eval()
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return layer


def draw(*shape):
    return torch.randn(*shape, dtype=torch.float64)


def leaves(state):
    return [state] if isinstance(state, torch.Tensor) else [leaf for part in state for leaf in leaves(part)]


def random_state(layer, x):
    return map_state(lambda zero: 0.5 * torch.randn_like(zero), layer.initial_state(len(x), x))


def norm(x, gain, shift):
    spread = (x.var(1, unbiased=False, keepdim=True) + 1e-5).sqrt()
    return gain * (x - x.mean(1, keepdim=True)) / spread + shift


def lstm_by_equations(x, state, held, rate):
    normed = "norm_gain_hh" in held
    (h, c), rows = state, []
    for t in range(x.shape[1]):
        into, back = x[:, t] @ held["weight_ih"].T, h @ held["weight_hh"].T
        if normed:
            z = norm(into, held["norm_gain_ih"], held["norm_shift_ih"]) + held["bias"]
            z = z + norm(back, held["norm_gain_hh"], held["norm_shift_hh"])
        else:
            z = into + held["bias_ih"] + back + held["bias_hh"]
        i, f, g, o = z.chunk(4, dim=1)
        new_c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
        seen = norm(new_c, held["norm_gain_c"], held["norm_shift_c"]) if normed else new_c
        new_h = torch.sigmoid(o) * torch.tanh(seen)
        h, c = rate * h + (1 - rate) * new_h, rate * c + (1 - rate) * new_c
        rows.append(h)
    return torch.stack(rows, dim=1), (h, c)


def gru_by_equations(x, state, held, rate):
    h, rows = state, []
    for t in range(x.shape[1]):
        into = x[:, t] @ held["weight_ih"].T + held["bias_ih"]
        back = h @ held["weight_hh"].T + held["bias_hh"]
        (ri, zi, ni), (rb, zb, nb) = into.chunk(3, dim=1), back.chunk(3, dim=1)
        new = torch.tanh(ni + torch.sigmoid(ri + rb) * nb)
        # The thesis's z lets the new value in; PyTorch's keeps the old one.
        update = 1 - torch.sigmoid(zi + zb)
        h = (1 - update) * h + update * new
        rows.append(h)
    return torch.stack(rows, dim=1), h


def min_gru_by_equations(x, h, held, rate):
    rows = []
    for t in range(x.shape[1]):
        gate, candidate = (x[:, t] @ held["gate_and_candidate.weight"].T + held["gate_and_candidate.bias"]).chunk(2, 1)
        z = torch.sigmoid(gate)
        h = (1 - z) * h + z * candidate
        rows.append(h)
    return torch.stack(rows, dim=1), h


def ssm_by_equations(x, state, held, rate):
    factor = torch.exp(torch.complex(-torch.exp(held["rate"]), held["angle"]))
    into = torch.view_as_complex(held["into.weight"].unflatten(0, (-1, 2)).transpose(1, 2).contiguous())
    h, rows = torch.complex(state[..., 0], state[..., 1]), []
    for t in range(x.shape[1]):
        h = factor * h + (1 - factor.abs() ** 2).sqrt() * (x[:, t].to(h.dtype) @ into.T)
        both = torch.stack([h.real, h.imag], dim=-1).flatten(1)
        value, gate = (both @ held["out.weight"].T + held["out.bias"]).chunk(2, dim=1)
        rows.append(value * torch.sigmoid(gate))
    return torch.stack(rows, dim=1), torch.stack([h.real, h.imag], dim=-1)


EQUATIONS = {
    "lstm": lstm_by_equations,
    "layer_norm_lstm": lstm_by_equations,
    "gru": gru_by_equations,
    "min_gru": min_gru_by_equations,
    "diagonal_ssm": ssm_by_equations,
}


def test_every_layer_has_its_equations():
    assert set(EQUATIONS) == set(CELLS)


@pytest.mark.parametrize("ticks", [1, 2, 23])
def test_a_layer_is_its_equations(kind, ticks):
    layer, x = make(kind), draw(2, ticks, 3)
    state = random_state(layer, x)
    held = {name.removeprefix("cell.").removesuffix("_l0"): p.detach() for name, p in layer.named_parameters()}
    wanted, last = EQUATIONS[kind[0]](x, state, held, kind[1])
    with torch.no_grad():
        found, new = layer(x, state)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)
    for ours, theirs in zip(leaves(new), leaves(last), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-12)


def test_the_gru_is_that_of_pytorch():
    ours, theirs = make(("gru", 0.0)), torch.nn.GRU(3, 4, batch_first=True).double()
    theirs.load_state_dict({f"{name}_l0": value for name, value in ours.state_dict().items()})
    x = draw(2, 15, 3)
    wanted, last = theirs(x)
    found, state = ours(x, ours.initial_state(2, x))
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)
    torch.testing.assert_close(state, last[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("training", [False, True])
def test_gradients_by_input_state_and_parameters(kind, training):
    layer = make(kind, width=2, units=3).train(training)
    x = draw(2, 6, 2).requires_grad_()
    state = map_state(lambda part: part.requires_grad_(), random_state(layer, x.detach()))
    assert all(parameter.requires_grad for parameter in layer.parameters())

    def run(x, *_):
        torch.manual_seed(1)  # the same draws of zoneout each time
        y, new = layer(x, state)
        return (y, *leaves(new))

    assert torch.autograd.gradcheck(run, (x, *leaves(state), *layer.parameters()))


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
def test_any_split_gives_the_same(kind, dtype, tolerance):
    layer = make(kind, units=8, dtype=dtype)
    x = draw(2, 301, 3).to(dtype)
    with torch.no_grad():
        whole, last = layer(x, layer.initial_state(2, x))
        for sizes in ([1] * 301, [300, 1], [7, 64, 1, 130, 99]):
            state, rows = layer.initial_state(2, x), []
            for piece in x.split(sizes, dim=1):
                y, state = layer(piece, state)
                rows.append(y)
            torch.testing.assert_close(torch.cat(rows, dim=1), whole, rtol=0, atol=tolerance)
            for ours, theirs in zip(leaves(state), leaves(last), strict=True):
                torch.testing.assert_close(ours, theirs, rtol=0, atol=tolerance)


def test_a_long_stream_stays_bounded_and_forgets_its_beginning(kind):
    layer = make(kind, units=6, dtype=torch.float32)
    x = torch.randn(1, 500, 3)
    with torch.no_grad():
        state = layer.initial_state(1, x)
        far = map_state(lambda zero: zero + 1.0, state)
        for _ in range(10):
            y, state = layer(x, state)
            z, far = layer(x, far)
    assert torch.isfinite(y).all()
    assert all(leaf.abs().max() < 1e3 for leaf in leaves(state))
    torch.testing.assert_close(y, z, rtol=0, atol=1e-4)


@pytest.mark.parametrize("ticks", [1, 2, 3, 16, 17, 50, 129])
@pytest.mark.parametrize("dtype", [torch.float64, torch.complex128])
@pytest.mark.parametrize("constant", [False, True])
def test_the_scan_and_its_gradients_are_those_of_a_loop(ticks, dtype, constant):
    a = 0.9 * torch.rand(*([3] if constant else [ticks, 2, 3]), dtype=torch.float64).to(dtype)
    a = a * torch.exp(1j * a.real) if dtype.is_complex else a
    b, start = torch.randn(ticks, 2, 3, dtype=dtype), torch.randn(2, 3, dtype=dtype)
    given = [value.clone().requires_grad_() for value in (a, b, start)]
    h, loop = given[2], []
    for t in range(ticks):
        h = (given[0] if constant else given[0][t]) * h + given[1][t]
        loop.append(h)
    wanted = torch.stack(loop)
    weights = torch.randn(wanted.shape, dtype=dtype)
    slopes = torch.autograd.grad((wanted * weights).sum().abs(), given)
    found = linear_scan(*given)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)
    for ours, theirs in zip(torch.autograd.grad((found * weights).sum().abs(), given), slopes, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", ["min_gru", "diagonal_ssm"])
def test_hours_of_stream_stay_bounded_and_equal_short_steps(name):
    layer = make((name, 0.0), units=4, dtype=torch.float32)
    x = torch.randn(1, 720_000, 3)  # two hours at 100 Hz
    with torch.no_grad():
        whole, last = layer(x, layer.initial_state(1, x))
        near, _ = layer(x[:, -5_000:], layer.initial_state(1, x))
    assert torch.isfinite(last).all()
    assert whole.abs().max() < 1e2
    torch.testing.assert_close(near[:, -100:], whole[:, -100:], rtol=0, atol=1e-4)


def test_a_state_space_cannot_leave_the_unit_circle():
    layer = CELLS["diagonal_ssm"](states=5).build(2, 3, 0.0)
    with torch.no_grad():
        layer.rate.copy_(torch.tensor([-60.0, -10.0, 0.0, 5.0, 60.0]))
        factor, scale = layer.factor()
    size = factor.norm(dim=1)
    assert (size <= 1.0).all()
    assert torch.isfinite(scale).all()
    torch.testing.assert_close(scale[1:, 0], (1 - size[1:].double() ** 2).sqrt().float(), rtol=1e-2, atol=1e-6)


def test_costs_name_every_parameter(kind):
    layer = make(kind)
    rows = layer.costs()
    assert sum(row.parameters for row in rows) == parameters_of(layer)
    assert (rows[0].width_in, rows[-1].width_out) == (3, 4)


ZONED = [name for name in CELLS if CELLS[name].zoneout]


@pytest.mark.parametrize("name", ZONED)
def test_zoneout_keeps_elements_at_its_rate_in_training_only(name):
    layer = make((name, 0.25), units=32).train()
    x = draw(8, 60, 3)
    before, (h, c) = random_state(layer, x), layer(x, layer.initial_state(8, x))[1]
    y, _ = layer(x, before)
    kept = (y[:, 1:] == y[:, :-1]).double().mean()
    assert abs(kept - 0.25) < 0.02
    # h and c are kept independently: after one tick, both at rate^2.
    _, (h, c) = layer(x[:, :1], before)
    both = ((h == before[0]) & (c == before[1])).double().mean()
    assert abs(both - 0.0625) < 0.05
    again, _ = layer(x, before)
    assert not torch.equal(again, y)
    layer.eval()
    torch.testing.assert_close(layer(x, before)[0], layer(x, before)[0], rtol=0, atol=0)


@pytest.mark.parametrize("name", ZONED)
def test_zoneout_adds_no_parameter_and_takes_the_weights_of_the_plain_layer(name):
    plain, zoned = make((name, 0.0)), make((name, 0.3))
    held = {key.removeprefix("cell."): value for key, value in plain.state_dict().items()}
    zoned.load_state_dict(held)
    zoned.rate = 0.0
    x = draw(2, 20, 3)
    torch.testing.assert_close(
        zoned(x, zoned.initial_state(2, x))[0], plain(x, plain.initial_state(2, x))[0], rtol=0, atol=1e-12
    )


@pytest.mark.parametrize(
    ("build", "reason"),
    [
        (lambda: GruSpec(cell=CELLS["layer_norm_lstm"]()), "'layer_norm_lstm' is of the family lstm.*'hybrid'"),
        (lambda: LstmSpec(cell=CELLS["gru"]()), "backbone 'lstm' with cell 'gru'.*family gru"),
        (lambda: HybridSpec(cell=CELLS["gru"](), zoneout=0.1), "h and c of an LSTM.*cells lstm, layer_norm_lstm"),
        (lambda: LstmSpec(zoneout=1.0), "zoneout = 1.0; 0 <= zoneout < 1 must hold"),
        (lambda: HybridSpec(layers=0), "layers = 0"),
    ],
)
def test_contradictions_are_refused_with_the_reason(build, reason):
    with pytest.raises(ConfigError, match=reason):
        build()
