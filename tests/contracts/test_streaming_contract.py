"""What every network that the registries allow must do: shapes, causality, streams, gradients, costs.

The contracts themselves ship as `edp.testing.streaming`, so that parts of third parties are held to them.
"""

import torch

from edp.testing import streaming


def test_shapes_and_dtype(structure, form, predictor_of):
    streaming.check_shapes(predictor_of(structure, form, torch.float32))


def test_the_future_does_not_reach_the_past(structure, predictor_of):
    streaming.check_causality(predictor_of(structure))


def test_a_step_a_chunk_and_a_window_agree_at_the_last_sample(structure, predictor_of):
    streaming.check_chunks(predictor_of(structure))


def test_reset_forgets_everything_in_the_streams_it_is_asked_for(structure, predictor_of):
    streaming.check_reset(predictor_of(structure))


def test_running_does_not_change_the_state_that_came(structure, predictor_of):
    streaming.check_state_is_left(predictor_of(structure))


def test_evaluation_is_deterministic_and_training_with_dropout_is_not(structure, predictor_of):
    streaming.check_determinism(predictor_of(structure, dtype=torch.float32))


def test_streams_of_a_batch_do_not_meet(structure, predictor_of):
    streaming.check_batch(predictor_of(structure))


def test_gradients_reach_every_parameter(structure, form, predictor_of):
    streaming.check_gradients(predictor_of(structure, form))


def test_cost_rows_count_every_parameter(structure, form, predictor_of):
    streaming.check_parameters_counted(predictor_of(structure, form))
