/* Runs S-functions as Simulink does: sizes, sample times, start, initial conditions, ticks, end. EDP's own code.
 *
 * A row of a run is the number of the block (0 or 1), the time in seconds, whether it is a minor step, reset, and the
 * measurements; of its results, all output ports one behind the other. */
#ifndef EDP_STUB_RUN_H
#define EDP_STUB_RUN_H

#include "simstruc.h"

#define BLOCKS 2
#define HEAD 4 /* columns before the measurements */

typedef struct {
    SimStruct block[BLOCKS];
} stub_run;

static size_t stub_bytes(int_T type) {
    return (type == SS_DOUBLE) ? sizeof(real_T) : (type == SS_BOOLEAN) ? sizeof(boolean_T) : sizeof(real32_T);
}

static void stub_make(stub_signal *signal) {
    const size_t count = (size_t)(signal->rows * signal->columns);
    signal->data = calloc((count > 0u) ? count : 1u, stub_bytes(signal->type));
}

static int_T stub_outputs(const SimStruct *S) {
    int_T total = 0;
    for (int_T port = 0; port < S->outputs; port++) {
        total += S->out[port].rows * S->out[port].columns;
    }
    return total;
}

/* What Simulink would not run, or would run in another way than EDP's blocks rely on. */
static const char *stub_judge(const SimStruct *S) {
    for (int_T port = 0; port < S->inputs; port++) {
        if (!S->in[port].direct || !S->in[port].contiguous || (S->in[port].rows < 1)) {
            return "stub: an input port has no width, is not contiguous or has no direct feedthrough";
        }
    }
    for (int_T port = 0; port < S->outputs; port++) {
        if ((S->out[port].rows < 1) || (S->out[port].columns < 1)) {
            return "stub: an output port has no size";
        }
    }
    for (int_T at = 0; at < S->works; at++) {
        if (S->work[at].rows < 1) {
            return "stub: a work vector has no width";
        }
    }
    return ((S->sample_times != 1) || !S->absolute_time) ? "stub: one sample time and absolute time are needed" : NULL;
}

static const char *stub_start(stub_run *run, void (*enter)(SimStruct *), real_T period) {
    const char *error = NULL;
    memset(run, 0, sizeof *run);
    for (int_T at = 0; at < BLOCKS; at++) {
        SimStruct *const S = &run->block[at];
        enter(S);
        S->sizes(S);
        if (S->error == NULL) {
            S->error = stub_judge(S);
        }
        if (S->error == NULL) {
            for (int_T port = 0; port < S->inputs; port++) {
                stub_make(&S->in[port]);
            }
            for (int_T port = 0; port < S->outputs; port++) {
                stub_make(&S->out[port]);
            }
            for (int_T port = 0; port < S->works; port++) {
                stub_make(&S->work[port]);
            }
            S->times(S);
        }
        if (S->sample_time == INHERITED_SAMPLE_TIME) {
            S->sample_time = period;
        }
        if (S->error == NULL) {
            S->start(S);
        }
        if (S->error == NULL) {
            S->initial(S);
        }
        error = (error == NULL) ? S->error : error;
    }
    return error;
}

/* One row; returns what the block complains of. */
static const char *stub_tick(stub_run *run, const real_T *row, real_T *results) {
    SimStruct *const S = &run->block[(row[0] > 0.5) ? 1 : 0];
    real32_T *const in = (real32_T *)S->in[0].data;
    int_T at = 0;
    S->now = row[1];
    S->minor = row[2] > 0.5;
    *(boolean_T *)S->in[1].data = (boolean_T)(row[3] > 0.5);
    for (int_T i = 0; i < S->in[0].rows; i++) {
        in[i] = (real32_T)row[HEAD + i];
    }
    S->tick(S, 0);
    for (int_T port = 0; port < S->outputs; port++) {
        const stub_signal *const y = &S->out[port];
        for (int_T i = 0; i < y->rows * y->columns; i++) {
            results[at++] = (y->type == SS_SINGLE) ? (real_T)((real32_T *)y->data)[i]
                            : (y->type == SS_INT32) ? (real_T)((int32_T *)y->data)[i]
                                                    : (real_T)((uint32_T *)y->data)[i];
        }
    }
    return S->error;
}

static void stub_end(stub_run *run) {
    for (int_T at = 0; at < BLOCKS; at++) {
        SimStruct *const S = &run->block[at];
        S->end(S);
        for (int_T port = 0; port < STUB_MOST; port++) {
            free(S->in[port].data);
            free(S->out[port].data);
            free(S->work[port].data);
        }
    }
}

#endif
