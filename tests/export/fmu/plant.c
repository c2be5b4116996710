/* An FMI 2.0 unit that no EDP exported: each stroke integrates a velocity that follows the difference of two pilot
 * pressures at once. Only what a plant needs works; all else is refused. */
#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#define AXES 3
#define GAIN 1e-7  /* m/s for a pascal */
#define EXPORT __attribute__((visibility("default")))

typedef struct {
    double pilots[2 * AXES], start[AXES], stroke[AXES], velocity[AXES];
    int steps;
} plant;

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT void *fmi2Instantiate(const char *n, int k, const char *g, const char *r, const void *c, int v, int l) {
    (void)n, (void)k, (void)r, (void)c, (void)v, (void)l;
    return (strcmp(g, "{plant}") == 0) ? calloc(1, sizeof(plant)) : NULL;
}
EXPORT void fmi2FreeInstance(void *p) { free(p); }
EXPORT int fmi2SetupExperiment(void *p, int a, double b, double c, int d, double e) {
    (void)p, (void)a, (void)b, (void)c, (void)d, (void)e;
    return 0;
}
EXPORT int fmi2EnterInitializationMode(void *p) { (void)p; return 0; }
EXPORT int fmi2ExitInitializationMode(void *p) {
    plant *const q = p;
    memcpy(q->stroke, q->start, sizeof q->stroke);
    return 0;
}
EXPORT int fmi2Terminate(void *p) { (void)p; return 0; }
EXPORT int fmi2Reset(void *p) { memset(p, 0, sizeof(plant)); return 0; }
EXPORT int fmi2SetReal(void *p, const unsigned *refs, size_t n, const double *values) {
    plant *const q = p;
    for (size_t i = 0; i < n; i++) {
        if (refs[i] >= 9) { return 3; }
        ((refs[i] < 6) ? q->pilots + refs[i] : q->start + (refs[i] - 6))[0] = values[i];
    }
    return 0;
}
EXPORT int fmi2GetReal(void *p, const unsigned *refs, size_t n, double *values) {
    const plant *const q = p;
    for (size_t i = 0; i < n; i++) {
        if (refs[i] < 10 || refs[i] >= 16) { return 3; }
        values[i] = (refs[i] < 13) ? q->velocity[refs[i] - 10] : q->stroke[refs[i] - 13];
    }
    return 0;
}
EXPORT int fmi2DoStep(void *p, double at, double size, int prior) {
    plant *const q = p;
    (void)prior;
    if (fabs(at - 0.01 * q->steps) > 1e-9) { return 3; }
    for (int i = 0; i < AXES; i++) {
        q->velocity[i] = GAIN * (q->pilots[2 * i] - q->pilots[2 * i + 1]);
        q->stroke[i] += size * q->velocity[i];
    }
    q->steps++;
    if (q->steps == BREAKS_AFTER) { q->velocity[1] = NAN; }
    return (q->steps == REFUSES_AFTER) ? 3 : 0;
}
