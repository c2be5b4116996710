/* An adversary of the adaptation: rows of inputs from standard input are fed for as many ticks as the first argument
 * says, and spoilt in turns: targets that belong to other moments, standstill, square waves, values far out, NaN and
 * infinity, missed ticks and resets, targets whose sign turns every few seconds, and nothing at all.
 * Prints: ticks with a correction, largest correction over its limit, results not finite, repairs, coefficients beyond
 * their bound, mean error in units without and with the correction, the largest ratio of both in a turn, share taken back.
 */
#include "predictor_adaptation.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#define TURN 30000u /* ticks */
#define TURNS 8u
#define NUMBERS (PREDICTOR_HORIZONS * PREDICTOR_TARGETS)

static predictor_state state;
static predictor_adaptation adaptation;
static const uint32_t column[PREDICTOR_TARGETS] = {COLUMNS};
static const uint32_t ahead[PREDICTOR_HORIZONS] = {AHEAD};
static predictor_output base[MOST_AHEAD + 1u];
static predictor_output better[MOST_AHEAD + 1u];
static uint32_t seed = 1u;

static uint32_t chance(uint32_t below) {
    seed = seed * 1664525u + 1013904223u;
    return (seed >> 8) % below;
}

static void spoil(uint32_t turn, uint32_t tick, const float *bank, uint32_t rows, float *in) {
    const float *const other = &bank[chance(rows) * PREDICTOR_INPUTS];
    const float *const first = &bank[((tick / 137u) % rows) * PREDICTOR_INPUTS];
    for (uint32_t i = 0; i < PREDICTOR_INPUTS; i++) {
        if (turn == 2u) {
            in[i] = bank[i];
        } else if (turn == 3u) {
            in[i] = first[i];
        } else if ((turn == 4u) && (chance(50u) == 0u)) {
            in[i] = other[i] * 1000.0f;
        } else if ((turn == 5u) && (chance(2000u) == 0u)) {
            in[i] = (chance(2u) == 0u) ? NAN : INFINITY;
        } else {
            /* as it came */
        }
    }
    for (uint32_t j = 0; j < PREDICTOR_TARGETS; j++) {
        if (turn == 1u) {
            in[column[j]] = other[column[j]];
        }
        if ((turn == 7u) && (((tick / 500u) % 2u) == 0u)) {
            in[column[j]] = -in[column[j]];
        }
    }
}

int main(int argc, char **argv) {
    const uint32_t ticks = (uint32_t)strtoul((argc > 1) ? argv[1] : "100000", NULL, 10);
    const uint32_t most_rows = 60000u;
    float *const bank = malloc(most_rows * PREDICTOR_INPUTS * sizeof(float));
    const uint32_t rows = (uint32_t)fread(bank, PREDICTOR_INPUTS * sizeof(float), most_rows, stdin);
    uint32_t corrected = 0u, broken = 0u, beyond = 0u, run = 0u, back = 0u;
    double worst = 0.0, without = 0.0, with = 0.0, turn_without = 0.0, turn_with = 0.0, ratio = 0.0, count = 0.0;
    predictor_reset(&state);
    predictor_adapt_reset(&adaptation);
    for (uint32_t tick = 0; tick < ticks; tick++) {
        const uint32_t turn = (tick / TURN) % TURNS;
        const uint32_t place = tick % (MOST_AHEAD + 1u);
        float in[PREDICTOR_INPUTS];
        edp_status step;
        edp_adapt_status status;
        edp_copy(&bank[(tick % rows) * PREDICTOR_INPUTS], PREDICTOR_INPUTS, in);
        spoil(turn, tick, bank, rows, in);
        if ((turn == 6u) && (chance(3000u) == 0u)) {
            predictor_reset(&state);
        }
        if ((turn == 6u) && (chance(500u) == 0u)) {
            step = predictor_missed(&state, 1u + chance(8u), &base[place]);
        } else {
            step = predictor_step(&state, in, &base[place]);
        }
        status = predictor_adapt(&adaptation, &state, (tick / 7000u) % 5u != 4u, &base[place], &better[place]);
        run = ((step == EDP_OK) && (status != EDP_ADAPT_NONE)) ? (run + 1u) : 0u;
        if (status == EDP_ADAPT_NONE) {
            continue;
        }
        corrected++;
        back += (status == EDP_ADAPT_FALLBACK) ? 1u : 0u;
        for (uint32_t h = 0; h < PREDICTOR_HORIZONS; h++) {
            const uint32_t then = (tick + MOST_AHEAD + 1u - ahead[h]) % (MOST_AHEAD + 1u);
            for (uint32_t j = 0; j < PREDICTOR_TARGETS; j++) {
                const double most = predictor_adapt_most[h][j];
                const double y = base[place].prediction[h][j], corrected_y = better[place].prediction[h][j];
                const double share = fabs(corrected_y - y) / (most + 1e-6 * fabs(y));
                broken += isfinite(corrected_y) ? 0u : 1u;
                worst = (share > worst) ? share : worst;
                for (uint32_t i = 0; i < PREDICTOR_ADAPT_FEATURES; i++) {
                    beyond += (fabsf(adaptation.learned.theta[h][j][i]) <= BOUND) ? 0u : 1u;
                }
                if (run > MOST_AHEAD) {
                    const double truth = in[column[j]];
                    const double plain = fmin(fabs(base[then].prediction[h][j] - truth) / most, 100.0);
                    const double kept = fmin(fabs(better[then].prediction[h][j] - truth) / most, 100.0);
                    without += plain;
                    with += kept;
                    turn_without += plain;
                    turn_with += kept;
                    count += 1.0;
                }
            }
        }
        if ((tick % TURN == TURN - 1u) && (turn_without > 0.0)) {
            ratio = (turn_with / turn_without > ratio) ? (turn_with / turn_without) : ratio;
            turn_without = 0.0;
            turn_with = 0.0;
        }
    }
    (void)printf("%u %.6f %u %u %u %.6f %.6f %.4f %.4f\n", (unsigned)corrected, worst, (unsigned)broken,
                 (unsigned)adaptation.repairs, (unsigned)beyond, without / count, with / count, ratio,
                 (double)back / (double)corrected);
    free(bank);
    return 0;
}
