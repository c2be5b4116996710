"""Choosing a formulation by free runs of what its fits left out, and averages of recurrent members."""

from dataclasses import replace

import numpy as np
import pytest

from edp.config.twin import TwinExperiment, load_twin_experiment
from edp.data.prepared import prepare
from edp.data.splits import ByRecording
from edp.data.twin_channels import twin_channels
from edp.errors import ConfigError, DataError
from edp.ir.memory import Gru
from edp.jobs import IN_PROCESS
from edp.networks.twin import TWINS, fit_scales
from edp.networks.twin.arx import Arx
from edp.networks.twin.elements import ElementsBox
from edp.networks.twin.lumped.parts import MassElement
from edp.networks.twin.model_selection import AutoTwin
from edp.networks.twin.recurrent import Recurrent, averaged, member_seed
from edp.networks.twin.static_map import StaticMap
from edp.progress import SilentProgress
from edp.storage.runs import KeyedRun, Run
from edp.testing.twins import sample_actuators, sample_series, sample_twin
from edp.training import free_run_members
from edp.training.fitted_twin import FreeRunProgress
from edp.training.free_run import FreeRunDiverged, FreeRunSpec
from edp.training.free_run_members import MemberTraining, fit_members, member_unit, read_progress_notes
from edp.training.optimizers import AdamW
from edp.workflows.twin import choose_twin, fit_twin, training_cost
from edp.workflows.twin.choose_twin import TwinChoice, shortened
from edp.workflows.twin.fit_twin import TwinFit

TINY = FreeRunSpec(batch=8, lengths_s=(0.2,), updates=(20,), validate_every=10, validation_s=2.0, optimizer=AdamW())


def choice(run, training=TINY, recordings=None, **auto):
    recordings = recordings or [sample_actuators(seed=seed) for seed in range(6)]
    channels = twin_channels(recordings[0])
    data = prepare(recordings, channels.task(), ByRecording(), 20)
    experiment = TwinExperiment(twin=AutoTwin(prefix_ticks=20, **auto), training=training)
    experiment = replace(experiment, evaluation=replace(experiment.evaluation, duration_s=4.0, calibration_starts=4))
    fit = TwinFit(channels, fit_scales(channels, data.train), data, experiment)
    return TwinChoice(fit, experiment.twin, KeyedRun(run, "k" * 32))


@pytest.fixture
def run(tmp_path):
    with Run(tmp_path / "run") as folder:
        yield folder


@pytest.mark.long
@pytest.mark.parametrize(("min_gain", "kept"), [(0.0, "n4sid"), (0.2, "arx"), (0.5, "static")])
def test_the_simplest_candidate_that_is_as_good_as_the_best_is_kept(run, monkeypatch, min_gain, kept):
    errors = iter([1.0, 0.7, 0.6])
    monkeypatch.setattr(TwinChoice, "_error", lambda self, runs, reference: next(errors))
    result, tried = choice(run, candidates=("static", "arx", "n4sid"), min_gain=min_gain, folds=2).best()
    assert [one.error for one in tried] == [1.0, 0.7, 0.6]
    assert [one.label for one in tried if one.chosen] == [kept]
    assert TWINS.name_of(result.spec) == kept
    assert result.fitted.facts == {"chosen": kept, "folds": 2}


@pytest.mark.long
def test_errors_are_those_of_the_static_map_and_of_free_runs(run, monkeypatch):
    monkeypatch.setattr(choose_twin, "FAR_BEHIND", 1e9)
    _, tried = choice(run, candidates=("static", "arx")).best()
    assert tried[0].error == pytest.approx(1.0, abs=1e-6)
    assert tried[1].error > 1.5  # ARX, fitted one tick ahead, drifts along these dead bands
    assert tried[0].chosen


def test_what_cannot_be_fitted_is_left_out_and_says_why(run, monkeypatch):
    def start(self, channels, scales, train, seed):
        raise DataError("these channels are not for it")

    monkeypatch.setattr(Arx, "start", start)
    _, tried = choice(run, candidates=("arx", "static")).best()
    assert (tried[0].error, tried[0].why) == (None, "these channels are not for it")
    assert tried[1].chosen
    with pytest.raises(ConfigError, match="none of them can be fitted to these recordings: arx: these channels"):
        choice(run, candidates=("arx",)).best()


def list_evaluated_channels(monkeypatch, errors, behind=1.0):
    """Let a training's errors be those by map and updates; of what was trained, in order, the keys."""
    trained = []
    plain_fit = free_run_members.fit_free_runs

    def fitted(twin, train, validation, training, *rest):
        trained.append((twin.static is not None, sum(training.updates)))
        return plain_fit(twin, train, validation, training, *rest)

    def error(self, runs, reference):
        return errors[trained[-1]] if len(runs) == len(self.folds) else behind

    monkeypatch.setattr(free_run_members, "fit_free_runs", fitted)
    monkeypatch.setattr(TwinChoice, "_error", error)
    return trained


@pytest.mark.long
def test_trainings_get_longer_as_long_as_that_helps_and_the_twin_is_the_average_over_the_folds(run, monkeypatch):
    errors = {(True, 1): 0.9, (False, 1): 0.8, (True, 3): 0.85, (False, 3): 0.6, (False, 9): 0.595}
    trained = list_evaluated_channels(monkeypatch, errors)
    result, tried = choice(run, candidates=("recurrent",)).best()
    # 0.595 is less than 1 % better than 0.6, so the full length is not tried; of one form the best length is kept.
    assert trained == [key for key in errors for _ in range(5)]
    assert [one.error for one in tried] == list(errors.values())
    assert result.spec == Recurrent(units=160, members=5, prefix_ticks=20)
    assert [one.label for one in tried if one.chosen] == ["recurrent (5 x 32 units), 9 updates"]
    assert {row["member"] for row in result.fitted.history} == {0, 1, 2, 3, 4}
    assert result.fitted.twin.network.units == 160
    assert len(result.unseen) == 5


@pytest.mark.long
def test_a_training_far_behind_the_best_one_is_given_up_after_two_folds(run, monkeypatch):
    errors = {(True, 1): 0.9, (True, 3): 0.95}
    trained = list_evaluated_channels(monkeypatch, errors, behind=1.6)
    monkeypatch.setattr(choose_twin, "FAR_BEHIND", 1.5)
    result, tried = choice(run, candidates=("recurrent",)).best()
    # Against a rival nothing else is better here; lengths end with the second one, which helped nobody.
    assert trained == [(True, 1)] * 5 + [(False, 1)] * 2 + [(True, 3)] * 2 + [(False, 3)] * 2
    assert [one.error for one in tried] == [0.9, None, None, None]
    assert tried[1].why == (
        "given up after 2 of 5 folds, with 1.60 times the error of recurrent (5 x 32 units, on the map), 1 updates "
        "there"
    )
    assert result.spec.valve_map
    monkeypatch.setattr(choose_twin, "FAR_BEHIND", 1.7)
    errors |= {(False, 1): 0.95, (False, 3): 0.8, (False, 9): 0.7}
    with Run(run.path / "again") as other:
        _, tried = choice(other, candidates=("recurrent",)).best()
    # Of a longer training yet, two folds without a gain are enough.
    assert [one.error for one in tried] == [0.9, 0.95, 0.95, 0.8, None]
    assert "given up after 2 of 5 folds" in tried[-1].why


@pytest.mark.long
def test_trainings_that_a_budget_has_no_time_for_are_left_out(run, monkeypatch):
    errors = {(True, 1): 0.9, (False, 1): 0.8, (True, 3): 0.85, (False, 3): 0.6}
    trained = list_evaluated_channels(monkeypatch, errors)
    # A minute of counted time an update: 1, 1 and 3 fit into six minutes, one more of 3 does not.
    monkeypatch.setattr(choose_twin, "training_seconds", lambda *parts: 60.0 * sum(parts[2].updates))
    _, tried = choice(run, candidates=("recurrent",), time_budget_min=6.0).best()
    assert trained == [key for key in [*errors][:3] for _ in range(5)]
    assert [one.error for one in tried] == [0.9, 0.8, 0.85, None]
    assert tried[-1].why == "about 8 min of counted time with those before it, of time_budget_min = 6"
    with Run(run.path / "again") as other:
        result, tried = choice(other, candidates=("static", "recurrent"), time_budget_min=0.5).best()
    assert result.spec == StaticMap(prefix_ticks=20)
    assert [one.label.split(",")[0] for one in tried] == ["static", "recurrent (5 x 32 units"]


def test_counted_time_grows_with_updates_lengths_units_and_members(run):
    fit = choice(run).fit

    def cost(units=32, members=1, updates=(100,), lengths=(1.0,)):
        training = replace(TINY, updates=updates, lengths_s=lengths)
        return training_cost.training_seconds(Recurrent(units=units), fit.channels, training, members)

    assert cost(members=3) == pytest.approx(3 * cost())
    assert cost(updates=(200,)) == pytest.approx(2 * cost())
    assert cost() < cost(units=64) < cost(units=64, lengths=(2.0,))


def test_every_tick_that_may_be_learned_from_is_left_out_by_one_fit_and_the_twin_has_learned_from_all(run):
    one = choice(run, candidates=("static",))
    result, _ = one.best()
    everything = [*one.fit.data.train, *one.fit.data.validation]
    left_out = sum(part.samples for _, series in result.unseen for part in series)
    assert left_out == sum(part.samples for part in everything)
    whole = StaticMap(prefix_ticks=20).start(one.fit.channels, fit_scales(one.fit.channels, everything), everything, 0)
    for name, values in whole.arrays().items():
        np.testing.assert_array_equal(result.fitted.twin.arrays()[name], values)
    fold = one.folds[2]
    alone = StaticMap(prefix_ticks=20).start(one.fit.channels, whole.scales, fold.train, 0)
    for name, values in alone.arrays().items():
        np.testing.assert_array_equal(result.unseen[2][0].arrays()[name], values)


@pytest.mark.long
def test_long_recordings_are_judged_by_the_validation_part_and_have_one_wide_network(run, monkeypatch):
    monkeypatch.setattr(choose_twin, "LONG_TICKS", 1)
    one = choice(run, candidates=("static", "recurrent"), min_gain=0.0)
    result, tried = one.best()
    assert [fold.train for fold in one.folds] == [one.fit.data.train]
    assert [fold.validation for fold in one.folds] == [one.fit.data.validation]
    assert tried[1].label.startswith("recurrent (96 units, on the map)")
    assert [twin for twin, _ in result.unseen] == [tried[i].trial.fits[0].fitted.twin for i in range(len(tried))
                                                   if tried[i].chosen]  # fmt: skip
    assert result.fitted.facts["folds"] == 1


@pytest.mark.parametrize(
    ("auto", "training"), [({"folds": 1}, {}), ({}, {"lengths_s": (30.0,)}), ({"folds": 32}, {"lengths_s": (2.0,)})]
)
def test_what_is_too_short_for_folds_keeps_the_division_of_the_settings(run, auto, training):
    one = choice(run, replace(TINY, **training), candidates=("static",), **auto)
    assert [fold.validation for fold in one.folds] == [one.fit.data.validation]


@pytest.mark.long
def test_a_training_that_diverges_leaves_the_other_forms_in(run, monkeypatch):
    plain_fit = free_run_members.fit_free_runs

    def fitted(twin, *rest):
        if twin.static is None:
            raise FreeRunDiverged("not finite any more")
        return plain_fit(twin, *rest)

    monkeypatch.setattr(free_run_members, "fit_free_runs", fitted)
    result, tried = choice(run, candidates=("recurrent",)).best()
    assert result.spec.valve_map
    assert {one.why for one in tried} == {"", "not finite any more"}

    def diverging(*rest):
        raise FreeRunDiverged("not finite any more")

    monkeypatch.setattr(free_run_members, "fit_free_runs", diverging)
    with pytest.raises(ConfigError, match=r"none of them can be fitted.*not finite any more"):
        choice(run, candidates=("recurrent",)).best()


class Stop(Exception):
    """Raised in place of Ctrl-C."""


@pytest.mark.long
def test_a_stopped_choice_goes_on_to_the_same_bits(tmp_path):
    training = replace(TINY, updates=(40,))

    def best(folder, stop_at=0):
        seen = []

        class Stopping(SilentProgress):
            def step(self, done, **values):
                seen.append(done)
                if len(seen) == stop_at:
                    raise Stop

        with Run(folder) as run:
            one = choice(run, training, candidates=("recurrent",))
            return TwinChoice(replace(one.fit, progress=Stopping()), one.auto, one.run).best()

    whole, _ = best(tmp_path / "whole")
    for stop_at in (3, 6):
        with pytest.raises(Stop):
            best(tmp_path / "stopped", stop_at)
    resumed, _ = best(tmp_path / "stopped")
    first, second = whole.fitted.twin.arrays(), resumed.fitted.twin.arrays()
    assert first.keys() == second.keys()
    assert all(np.array_equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("pulls", [(1.0, 1.0, 1.0), (0.9, 0.2, 0.0), (0.0, 0.0, 0.0)])
def test_an_average_of_members_on_maps_of_their_own_is_pulled_to_one_map(pulls):
    spec = Recurrent(units=6, members=3, valve_map=True)
    whole, commands, measured = sample_twin(spec)
    channels, scales = whole.channels, whole.scales
    # Nothing may be bounded: the map of one recording alone goes far.
    scales = replace(scales, low=scales.low - 1e4 * scales.answer_width, high=scales.high + 1e4 * scales.answer_width)
    series = [channels.task().series(sample_actuators(seed=seed)) for seed in range(3)]
    static = spec.static_map(channels, scales, series)
    members = [spec.member(channels, scales, static.refitted(series[i : i + 1]), i) for i in range(3)]
    for member, pull in zip(members, pulls, strict=True):
        member.network.pull.data *= pull
    answers = [twin.rollout(commands, twin.initial_state(commands[:, 0], measured[:, 0]), measured)[0]
               for twin in (averaged(members), *members)]  # fmt: skip
    assert not np.array_equal(members[0].static.numbers["rise"], members[1].static.numbers["rise"])
    count = len(channels.velocities)
    columns = [*range(count), *range(2 * count, len(channels.answers))]
    mean = np.mean([one[..., columns] for one in answers[1:]], axis=0)
    np.testing.assert_allclose(answers[0][..., columns] / scales.answer_width[columns],
                               mean / scales.answer_width[columns], rtol=2e-5, atol=2e-5)  # fmt: skip


@pytest.mark.parametrize("valve_map", [False, True])
def test_an_average_answers_with_the_mean_of_the_changes_of_its_members(valve_map):
    spec = Recurrent(units=6, members=3, valve_map=valve_map)
    whole, commands, measured = sample_twin(spec)
    channels, scales = whole.channels, whole.scales
    # End stops are far away: where one acts, an answer is no sum any more.
    scales = replace(scales, low=scales.low - 9 * scales.answer_width, high=scales.high + 9 * scales.answer_width)
    train = [channels.task().series(sample_actuators())]
    whole = spec.start(channels, scales, train, seed=1)
    static = spec.static_map(channels, scales, train)
    members = [spec.member(channels, scales, static, member_seed(1, i)) for i in range(3)]
    # Only while all ports are measured do members alone read what they read together.
    answers = [twin.rollout(commands, twin.initial_state(commands[:, 0], measured[:, 0]), measured)[0]
               for twin in (whole, *members)]  # fmt: skip
    count = len(channels.velocities)
    columns = [*range(count), *range(2 * count, len(channels.answers))]
    mean = np.mean([one[..., columns] for one in answers[1:]], axis=0)
    np.testing.assert_allclose(answers[0][..., columns] / scales.answer_width[columns],
                               mean / scales.answer_width[columns], atol=2e-6)  # fmt: skip
    assert averaged(members[:1]) is members[0]


def test_members_are_layers_of_their_own_in_exports_until_they_read_one_another():
    twin, _, _ = sample_twin(Recurrent(units=6, members=3))
    memories = [layer for layer in twin.graph().layers if isinstance(layer, Gru)]
    assert [layer.weight_h.shape for layer in memories] == [(6, 2)] * 3
    twin.network.h_weight.data[0, 3] = 0.5
    memories = [layer for layer in twin.graph().layers if isinstance(layer, Gru)]
    assert [layer.weight_h.shape for layer in memories] == [(18, 6)]


def test_an_untrained_network_on_a_static_map_that_changes_nothing_is_the_map():
    spec = Recurrent(units=4, valve_map=True)
    twin, commands, measured = sample_twin(spec)
    for weight in (twin.network.out_weight, twin.network.out_bias):
        weight.data.zero_()
    prefix = twin.prefix_ticks
    runs = []
    for one in (twin, twin.static):
        state = one.reset(commands[:, :prefix], measured[:, :prefix])
        runs.append(one.rollout(commands[:, prefix:], state)[0] / twin.scales.answer_width)
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-5)


@pytest.mark.long
def test_members_have_seeds_of_their_own_and_the_first_one_that_of_the_training():
    channels, series = sample_series(4)
    scales = fit_scales(channels, series[:3])
    form = Recurrent(units=6, members=2, prefix_ticks=10)
    parts = (channels, scales, None)
    both = fit_members(form, parts, (series[:3], series[3:]), TINY).twin.network
    alone = fit_members(form.alone(), parts, (series[:3], series[3:]), TINY).twin.network
    own = slice(0, 3)
    np.testing.assert_array_equal(both.h_weight.detach()[own, own], alone.h_weight.detach()[:, own])
    assert not np.array_equal(both.h_weight.detach()[3:, 3:6], alone.h_weight.detach()[:, own])
    assert not both.h_weight.detach()[own, 3:6].any()


def test_a_share_of_a_training_keeps_its_stages():
    short = shortened(FreeRunSpec(), 0.05)
    assert short.updates == (75, 100, 150, 25)
    assert short.validate_every == 12
    assert shortened(TINY, 1e-6).updates == (1,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("twin.candidates=[]", "candidates"),
        ("twin.candidates=['static','rekurrent']", "unknown twin 'rekurrent'; did you mean 'recurrent'"),
        ("twin.candidates=['arx','arx']", "each once must hold"),
        ("twin.candidates=['auto']", "unknown twin 'auto'"),
        ("twin.units=64", "unknown key 'twin.units'; it belongs to kind = 'recurrent' or 'residual'"),
        ("twin.min_gain=1.5", "min_gain = 1.5"),
        ("twin.folds=0", "folds = 0"),
        ("twin.folds=33", "folds = 33"),
        ("twin={kind='recurrent',units=10,members=3}", "10 units and 3 members; a whole number"),
        ("twin={kind='recurrent',units=66,members=33}", "members = 33"),
    ],
)
def test_settings_that_cannot_be_are_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        load_twin_experiment(None, [change])


@pytest.mark.long
def test_trainings_side_by_side_note_how_far_they_are(run):
    channels, series = sample_series(2)
    scales = fit_scales(channels, series)
    jobs = []
    for which in range(3):
        member = Recurrent(units=3).member(channels, scales, None, which)
        folder = (run.path / f"member_{which}", "k" * 32)
        jobs.append(MemberTraining(f"member {which}", member, series, series, TINY, folder))
    assert read_progress_notes(jobs) is None
    for job in jobs[:2]:
        list(IN_PROCESS.map([member_unit(job)]))
    (run.path / "member_2").mkdir()
    note = run.path / "member_2" / "progress.json"
    note.write_text("{ half a")  # as it may be read while it is written
    event = read_progress_notes(jobs)
    assert (event.update, event.updates) == (40, 60)
    assert event.validation > 0.0
    jobs[2] = replace(jobs[2], folder=None)
    assert read_progress_notes(jobs).update == 40


def test_a_choice_looks_at_its_workers_while_it_waits(run, monkeypatch):
    looks = []

    class Waiting:
        are_alone = False

        def map(self, units, waiting):
            waiting()
            waiting()
            return iter([])

    seen = iter([None, FreeRunProgress(3, 9, 0.1, 1.0, None, False)])
    monkeypatch.setattr(fit_twin, "read_progress_notes", lambda jobs: next(seen))
    fit = replace(choice(run).fit, workers=Waiting())
    assert list(fit.train_members([], looks.append)) == []
    assert [event.update for event in looks] == [3]


AXES = ElementsBox(
    masses=tuple(MassElement(name=f"m{i}", command=f"lever_{i}", velocity=f"speed_{i}") for i in (1, 2)),
    starts=1, rounds=2, length_s=1.0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("candidates", "tried"),
    [
        (("static", "recurrent"), ("static", "elements", "recurrent")),
        (("static",), ("static", "elements")),
        (("elements", "static"), ("elements", "static")),
    ],
)
def test_known_elements_are_one_more_candidate_before_the_networks(candidates, tried):
    assert AutoTwin(candidates=candidates).tried == candidates
    assert AutoTwin(candidates=candidates, elements=AXES).tried == tried


@pytest.mark.long
def test_known_elements_are_fitted_without_each_fold_and_at_last_to_everything(run, monkeypatch):
    recordings = [sample_actuators(seed=seed, pressures=False) for seed in range(6)]
    fits = []
    plain = fit_twin.fit_elements

    def noted(twin, train, validation, *rest):
        fits.append([sum(part.samples for part in side) for side in (train, validation)])
        return plain(twin, train, validation, *rest)

    monkeypatch.setattr(fit_twin, "fit_elements", noted)
    monkeypatch.setattr(TwinChoice, "_error", lambda self, runs, reference: 0.5 if fits else 1.0)
    one = choice(run, recordings=recordings, candidates=("static",), elements=AXES, folds=2)
    result, tried = one.best()
    assert [row.label for row in tried] == ["static", "elements"]
    assert result.spec == replace(AXES, prefix_ticks=20)
    assert {row.element for row in result.fitted.datasheet} == {"m1", "m2"}
    everything = sum(part.samples for part in [*one.fit.data.train, *one.fit.data.validation])
    assert fits[-1] == [everything, everything]
    assert len(fits) == 3
    assert all(train < everything for train, _ in fits[:-1])


def test_known_elements_are_read_from_settings_and_written_to_them():
    name = 'twin.elements.masses=[{name="axis", command="u", velocity="v"}]'
    experiment = load_twin_experiment(None, (name, "twin.elements.starts=2"))
    assert experiment.twin.elements.masses == (MassElement(name="axis", command="u", velocity="v"),)
    assert experiment.twin.elements.starts == 2
    with pytest.raises(ConfigError, match="startz"):
        load_twin_experiment(None, (name, "twin.elements.startz=2"))


def test_a_slow_log_is_trained_and_judged_by_ticks(run):
    recordings = [replace(sample_actuators(seed=seed), rate_hz=1.0) for seed in range(6)]
    one = choice(run, FreeRunSpec(), recordings, candidates=("static",))
    assert max(one.training.lengths_s) == 100.0
    assert one.training.validation_s == 150.0
    assert len(one.folds) == 5
