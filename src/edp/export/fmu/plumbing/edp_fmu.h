/* An instance of a predictor in a co-simulation: what both versions of FMI share. C99; the heap is used for instances and
 * saved states only, there are no globals.
 *
 * A step reads the inputs set before it, and its predictions can be read after it. Ticks follow each other without gaps:
 * a step of another size is refused; whole ticks that were left out are held, as the rules of the model's header say.
 */
#ifndef EDP_FMU_H
#define EDP_FMU_H

#include "fmu_model.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define FMU_OUTPUTS (sizeof(FMU_OUTPUT) / sizeof(float))

/* Value references: inputs, outputs, then these; `time` of FMI 3 comes last. */
enum {
    FMU_REF_OUTPUTS = FMU_INPUTS,
    FMU_REF_STATUS = FMU_REF_OUTPUTS + (int)FMU_OUTPUTS,
    FMU_REF_VALID,
    FMU_REF_REJECTED,
    FMU_REF_HELD,
    FMU_REF_RESTARTS,
    FMU_REF_TIME
};

/* Numbers as in both versions of FMI. */
typedef enum { EDP_FMU_OK = 0, EDP_FMU_WARNING = 1, EDP_FMU_DISCARD = 2, EDP_FMU_ERROR = 3 } edp_fmu_status;

typedef enum { EDP_FMU_NEW = 0, EDP_FMU_INITIALISING = 1, EDP_FMU_STEPPING = 2, EDP_FMU_ENDED = 3 } edp_fmu_mode;

/* All that changes: what is saved and restored. */
typedef struct {
    edp_fmu_mode mode;
    edp_status status; /* of the last step; EDP_RESTARTED before the first one */
    bool stepped;
    double next; /* s, where the next step begins */
    double inputs[FMU_INPUTS];
    bool given[FMU_INPUTS];
    FMU_OUTPUT out;
    FMU_STATE state;
} edp_fmu_memory;

/* A saved state; the token in front says whose it is. */
typedef struct {
    char token[sizeof FMU_TOKEN];
    edp_fmu_memory memory;
} edp_fmu_saved;

typedef struct edp_fmu edp_fmu;

/* Passes a message to the importer. */
typedef void edp_fmu_tell(const edp_fmu *f, edp_fmu_status status, const char *category, const char *message);

struct edp_fmu {
    edp_fmu_memory now;
    edp_fmu_tell *tell;
    bool talkative; /* tell of every tick that was held, not of the first in a row only */
#ifdef FMU_TANGENT
    FMU_STATE copy;
    FMU_TANGENT tangent;
#endif
};

/* Why no instance is made, or NULL. */
const char *edp_fmu_refused(const char *name, const char *token);
/* As after instantiation. */
void edp_fmu_clear(edp_fmu *f);
/* Logs a message and returns EDP_FMU_ERROR. */
edp_fmu_status edp_fmu_wrong(const edp_fmu *f, const char *message);

edp_fmu_status edp_fmu_begin(edp_fmu *f, double start);
edp_fmu_status edp_fmu_ready(edp_fmu *f);
edp_fmu_status edp_fmu_end(edp_fmu *f);
/* One tick from `at` to `at` + `size`, both in s. */
edp_fmu_status edp_fmu_step(edp_fmu *f, double at, double size);

edp_fmu_status edp_fmu_get_real(const edp_fmu *f, uint32_t ref, double *value);
edp_fmu_status edp_fmu_set_real(edp_fmu *f, uint32_t ref, double value);
edp_fmu_status edp_fmu_get_integer(const edp_fmu *f, uint32_t ref, int32_t *value);
edp_fmu_status edp_fmu_get_flag(const edp_fmu *f, uint32_t ref, bool *value);

/* `kept` is made if it is NULL. States of another FMU are refused here and in what follows. */
edp_fmu_status edp_fmu_save(const edp_fmu *f, edp_fmu_saved **kept);
edp_fmu_status edp_fmu_restore(edp_fmu *f, const edp_fmu_saved *kept);
size_t edp_fmu_bytes(void);
edp_fmu_status edp_fmu_write(const edp_fmu *f, const edp_fmu_saved *kept, void *bytes, size_t size);
/* `kept` is made. */
edp_fmu_status edp_fmu_read(const edp_fmu *f, const void *bytes, size_t size, edp_fmu_saved **kept);

/* The seed of an input, collected in `seeds`, which the caller sets to zero first. */
edp_fmu_status edp_fmu_seed(const edp_fmu *f, uint32_t ref, double seed, float seeds[FMU_INPUTS]);
/* How the predictions of a step made now, with the inputs as they are, change along `seeds`; the memory is taken as it
 * is and left so. `changes` holds FMU_OUTPUTS. */
edp_fmu_status edp_fmu_derive(edp_fmu *f, const float seeds[FMU_INPUTS], float *changes);
/* The change of one of them. */
edp_fmu_status edp_fmu_change(const edp_fmu *f, uint32_t ref, const float *changes, double *change);

#endif
