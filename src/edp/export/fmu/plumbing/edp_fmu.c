/* What both versions of FMI share: order of calls, ticks, values, saved states, derivatives. */
#include "edp_fmu.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define TEXT 400u
#define SIZE_SLACK 1e-6 /* of a step, for the rounding of time in the importer */
#define TIME_SLACK 1e-2

static const char *const input_names[FMU_INPUTS] = {FMU_INPUT_NAMES};

/* What stands before the bytes of a saved state. */
typedef struct {
    char token[sizeof FMU_TOKEN];
    uint32_t size;
    uint32_t crc;
} heading;

const char *edp_fmu_refused(const char *name, const char *token) {
    const char *why = NULL;
    if ((name == NULL) || (name[0] == '\0')) {
        why = "no instance without a name";
    } else if ((token == NULL) || (strcmp(token, FMU_TOKEN) != 0)) {
        why = "the GUID or token is not the one of this FMU: modelDescription.xml and binary are of different exports";
    } else if (!FMU_CHECK()) {
        why = "the weights have not the checksum they were exported with: the binary is damaged";
    }
    return why;
}

void edp_fmu_clear(edp_fmu *f) {
    (void)memset(&f->now, 0, sizeof f->now);
    f->now.status = EDP_RESTARTED;
    FMU_RESET(&f->now.state);
}

edp_fmu_status edp_fmu_wrong(const edp_fmu *f, const char *message) {
    f->tell(f, EDP_FMU_ERROR, "logStatusError", message);
    return EDP_FMU_ERROR;
}

/* ---- order of calls --------------------------------------------------------------------------------------------- */

edp_fmu_status edp_fmu_begin(edp_fmu *f, double start) {
    if (f->now.mode != EDP_FMU_NEW) {
        return edp_fmu_wrong(f, "the initialisation was entered before: reset the instance first");
    }
    if (!(fabs(start) <= DBL_MAX)) {
        return edp_fmu_wrong(f, "the start time must be a finite number");
    }
    f->now.mode = EDP_FMU_INITIALISING;
    f->now.next = start;
    return EDP_FMU_OK;
}

edp_fmu_status edp_fmu_ready(edp_fmu *f) {
    if (f->now.mode != EDP_FMU_INITIALISING) {
        return edp_fmu_wrong(f, "the initialisation was not entered");
    }
    f->now.mode = EDP_FMU_STEPPING;
    return EDP_FMU_OK;
}

edp_fmu_status edp_fmu_end(edp_fmu *f) {
    if (f->now.mode != EDP_FMU_STEPPING) {
        return edp_fmu_wrong(f, "there is nothing to terminate: the instance is not initialised, or has ended");
    }
    f->now.mode = EDP_FMU_ENDED;
    return EDP_FMU_OK;
}

/* ---- a step ------------------------------------------------------------------------------------------------------ */

/* Whole ticks left out before `at`, or -1 after a message why there is no step. */
static int32_t left_out(const edp_fmu *f, double at, double size) {
    char text[TEXT];
    const double gap = (at - f->now.next) / FMU_STEP_S;
    const double whole = floor(gap + 0.5);
    int32_t ticks = -1;
    if (f->now.mode != EDP_FMU_STEPPING) {
        (void)edp_fmu_wrong(f, "a step needs an instance that is initialised and has not ended");
    } else if (!(fabs(size - FMU_STEP_S) <= SIZE_SLACK * FMU_STEP_S)) {
        (void)snprintf(text, sizeof text,
                       "the step is %.9g s long; this predictor was trained at %.9g Hz and takes steps of %.9g s only: "
                       "set the communication step size to that",
                       size, FMU_RATE_HZ, FMU_STEP_S);
        (void)edp_fmu_wrong(f, text);
    } else if (!((whole >= 0.0) && (whole < 1e9) && (fabs(gap - whole) <= TIME_SLACK))) {
        (void)snprintf(text, sizeof text,
                       "the step begins at %.9g s, where the ticks before it end at %.9g s; it must begin there, or whole "
                       "ticks of %.9g s later, which are then held: to go back restore a state or reset",
                       at, f->now.next, FMU_STEP_S);
        (void)edp_fmu_wrong(f, text);
    } else {
        ticks = (int32_t)whole;
    }
    return ticks;
}

/* Inputs as the model reads them: what must be set and was not, or is no float, becomes NaN, which it rejects. */
static void read_inputs(const edp_fmu *f, float read[FMU_INPUTS]) {
    for (uint32_t i = 0; i < FMU_INPUTS; i++) {
        const bool sound = (f->now.given[i] || (i >= FMU_REQUIRED)) && (fabs(f->now.inputs[i]) <= (double)FLT_MAX);
        read[i] = sound ? (float)f->now.inputs[i] : NAN;
    }
}

/* Why a step did not use its inputs. */
static void explain(const edp_fmu *f, const float read[FMU_INPUTS], bool rejected, char text[TEXT]) {
    uint32_t bad = 0;
    while ((bad < FMU_INPUTS) && edp_finite(read[bad])) {
        bad++;
    }
    if (!rejected) {
        (void)snprintf(text, TEXT, "a result was not finite");
    } else if (bad == FMU_INPUTS) {
        (void)snprintf(text, TEXT, "an input is beyond its limits");
    } else if (f->now.given[bad] || (bad >= FMU_REQUIRED)) {
        (void)snprintf(text, TEXT, "input '%.100s' is %g", input_names[bad], f->now.inputs[bad]);
    } else {
        (void)snprintf(text, TEXT, "input '%.100s' was never set", input_names[bad]);
    }
}

edp_fmu_status edp_fmu_step(edp_fmu *f, double at, double size) {
    float read[FMU_INPUTS];
    char text[2u * TEXT], why[TEXT];
    const int32_t missed = left_out(f, at, size);
    const edp_status earlier = f->now.status;
    const bool first = !f->now.stepped;
    edp_fmu_status done = EDP_FMU_OK;
    if (missed < 0) {
        return EDP_FMU_ERROR;
    }
    if (missed > 0) {
        (void)FMU_MISSED(&f->now.state, (uint32_t)missed, &f->now.out);
        (void)snprintf(text, sizeof text, "%ld ticks were left out before %.9g s: held as the model's rules say",
                       (long)missed, at);
        f->tell(f, EDP_FMU_WARNING, "logStatusWarning", text);
        done = EDP_FMU_WARNING;
    }
    const uint32_t rejected = f->now.state.rejected;
    read_inputs(f, read);
    f->now.status = FMU_STEP(&f->now.state, read, &f->now.out);
    f->now.stepped = true;
    f->now.next = at + size;
    if (f->now.status > EDP_WARMING) {
        done = EDP_FMU_WARNING;
        if (first || f->talkative || (f->now.status != earlier)) {
            explain(f, read, f->now.state.rejected != rejected, why);
            (void)snprintf(text, sizeof text, "tick at %.9g s: %s; %s", at, why,
                           (f->now.status == EDP_HELD)
                               ? "the last accepted inputs were used again"
                               : "there is no prediction, the outputs keep their values, and the memory is cleared");
            f->tell(f, EDP_FMU_WARNING, "logStatusWarning", text);
        }
    }
    return done;
}

/* ---- values ------------------------------------------------------------------------------------------------------- */

static edp_fmu_status unknown(const edp_fmu *f, uint32_t ref, const char *what) {
    char text[TEXT];
    (void)snprintf(text, sizeof text, "value reference %lu is not that of %s", (unsigned long)ref, what);
    return edp_fmu_wrong(f, text);
}

edp_fmu_status edp_fmu_get_real(const edp_fmu *f, uint32_t ref, double *value) {
    if (ref < FMU_INPUTS) {
        *value = f->now.inputs[ref];
    } else if (ref < (uint32_t)FMU_REF_STATUS) {
        float number;
        (void)memcpy(&number, (const char *)&f->now.out + (ref - FMU_INPUTS) * sizeof number, sizeof number);
        *value = (double)number;
    } else if (ref == (uint32_t)FMU_REF_TIME) {
        *value = f->now.next;
    } else {
        return unknown(f, ref, "a real variable");
    }
    return EDP_FMU_OK;
}

edp_fmu_status edp_fmu_set_real(edp_fmu *f, uint32_t ref, double value) {
    if (ref >= FMU_INPUTS) {
        return unknown(f, ref, "an input");
    }
    if (f->now.mode == EDP_FMU_ENDED) {
        return edp_fmu_wrong(f, "inputs cannot be set: the simulation has ended");
    }
    f->now.inputs[ref] = value;
    f->now.given[ref] = true;
    return EDP_FMU_OK;
}

edp_fmu_status edp_fmu_get_integer(const edp_fmu *f, uint32_t ref, int32_t *value) {
    uint32_t count;
    switch (ref) {
    case FMU_REF_STATUS:
        count = (uint32_t)f->now.status;
        break;
    case FMU_REF_REJECTED:
        count = f->now.state.rejected;
        break;
    case FMU_REF_HELD:
        count = f->now.state.held;
        break;
    case FMU_REF_RESTARTS:
        count = f->now.state.restarts;
        break;
    default:
        return unknown(f, ref, "an integer");
    }
    *value = (count < (uint32_t)INT32_MAX) ? (int32_t)count : INT32_MAX;
    return EDP_FMU_OK;
}

edp_fmu_status edp_fmu_get_flag(const edp_fmu *f, uint32_t ref, bool *value) {
    if (ref != (uint32_t)FMU_REF_VALID) {
        return unknown(f, ref, "a Boolean");
    }
    *value = f->now.stepped && (f->now.status == EDP_OK);
    return EDP_FMU_OK;
}

/* ---- saved states ------------------------------------------------------------------------------------------------- */

/* Whether a saved state has this FMU's token. Read up to the first difference only: one of another FMU may be shorter. */
static bool ours(const edp_fmu_saved *kept) {
    const char *const token = FMU_TOKEN;
    size_t same = 0;
    while ((same < sizeof kept->token) && (kept->token[same] == token[same])) {
        same++;
    }
    return same == sizeof kept->token;
}

/* An empty state with the token; NULL without memory. */
static edp_fmu_saved *made(void) {
    edp_fmu_saved *const kept = malloc(sizeof *kept);
    if (kept != NULL) {
        (void)memset(kept, 0, sizeof *kept);
        (void)memcpy(kept->token, FMU_TOKEN, sizeof kept->token);
    }
    return kept;
}

edp_fmu_status edp_fmu_save(const edp_fmu *f, edp_fmu_saved **kept) {
    if (*kept == NULL) {
        *kept = made();
        if (*kept == NULL) {
            return edp_fmu_wrong(f, "no memory for a saved state");
        }
    } else if (!ours(*kept)) {
        return edp_fmu_wrong(f, "the state to write over is one of another FMU");
    }
    (void)memcpy(&(*kept)->memory, &f->now, sizeof f->now);
    return EDP_FMU_OK;
}

edp_fmu_status edp_fmu_restore(edp_fmu *f, const edp_fmu_saved *kept) {
    if (kept == NULL) {
        return edp_fmu_wrong(f, "there is no state to restore");
    }
    if (!ours(kept)) {
        return edp_fmu_wrong(f, "the state to restore is one of another FMU");
    }
    (void)memcpy(&f->now, &kept->memory, sizeof f->now);
    return EDP_FMU_OK;
}

size_t edp_fmu_bytes(void) { return sizeof(heading) + sizeof(edp_fmu_memory); }

static heading heading_of(const void *bytes) {
    const edp_table table = {bytes, (uint32_t)sizeof(edp_fmu_memory), 1u};
    heading made;
    (void)memset(&made, 0, sizeof made);
    (void)memcpy(made.token, FMU_TOKEN, sizeof FMU_TOKEN);
    made.size = (uint32_t)sizeof(edp_fmu_memory);
    made.crc = edp_crc(&table, 1u);
    return made;
}

edp_fmu_status edp_fmu_write(const edp_fmu *f, const edp_fmu_saved *kept, void *bytes, size_t size) {
    if ((kept == NULL) || (bytes == NULL) || (size < edp_fmu_bytes())) {
        return edp_fmu_wrong(f, "a state cannot be serialised: none was given, or the place for it is too small");
    }
    if (!ours(kept)) {
        return edp_fmu_wrong(f, "the state to serialise is one of another FMU");
    }
    const heading head = heading_of(&kept->memory);
    (void)memcpy(bytes, &head, sizeof head);
    (void)memcpy((char *)bytes + sizeof head, &kept->memory, sizeof kept->memory);
    return EDP_FMU_OK;
}

edp_fmu_status edp_fmu_read(const edp_fmu *f, const void *bytes, size_t size, edp_fmu_saved **kept) {
    if ((bytes == NULL) || (size != edp_fmu_bytes())) {
        return edp_fmu_wrong(f, "these bytes have not the length of a serialised state of this FMU");
    }
    const char *const content = (const char *)bytes + sizeof(heading);
    const heading head = heading_of(content);
    if (memcmp(bytes, &head, sizeof head) != 0) {
        return edp_fmu_wrong(f, "these bytes are no serialised state of this FMU, or are damaged");
    }
    *kept = made();
    if (*kept == NULL) {
        return edp_fmu_wrong(f, "no memory for a saved state");
    }
    (void)memcpy(&(*kept)->memory, content, sizeof (*kept)->memory);
    return EDP_FMU_OK;
}

/* ---- derivatives --------------------------------------------------------------------------------------------------- */

edp_fmu_status edp_fmu_seed(const edp_fmu *f, uint32_t ref, double seed, float seeds[FMU_INPUTS]) {
    if (ref >= FMU_INPUTS) {
        return unknown(f, ref, "an input; derivatives are by inputs");
    }
    seeds[ref] += (float)seed;
    return EDP_FMU_OK;
}

edp_fmu_status edp_fmu_change(const edp_fmu *f, uint32_t ref, const float *changes, double *change) {
    if ((ref < (uint32_t)FMU_REF_OUTPUTS) || (ref >= (uint32_t)FMU_REF_STATUS)) {
        return unknown(f, ref, "a prediction; derivatives are of predictions");
    }
    *change = (double)changes[ref - (uint32_t)FMU_REF_OUTPUTS];
    return EDP_FMU_OK;
}

#ifdef FMU_TANGENT
edp_fmu_status edp_fmu_derive(edp_fmu *f, const float seeds[FMU_INPUTS], float *changes) {
    FMU_OUTPUT out, moved;
    float read[FMU_INPUTS];
    read_inputs(f, read);
    (void)memcpy(&f->copy, &f->now.state, sizeof f->copy);
    FMU_TANGENT_RESET(&f->tangent);
    if (FMU_STEP_TANGENT(&f->copy, &f->tangent, read, seeds, &out, &moved) > EDP_WARMING) {
        f->tell(f, EDP_FMU_DISCARD, "logStatusWarning", "no derivatives: the inputs as they are give no prediction");
        return EDP_FMU_DISCARD;
    }
    (void)memcpy(changes, &moved, sizeof moved);
    return EDP_FMU_OK;
}
#else
edp_fmu_status edp_fmu_derive(edp_fmu *f, const float seeds[FMU_INPUTS], float *changes) {
    (void)seeds;
    (void)changes;
    return edp_fmu_wrong(f, "this FMU provides no derivatives");
}
#endif
