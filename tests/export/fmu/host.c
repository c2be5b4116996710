/* Loads the DLL of an FMU (FMI 2.0) and streams rows of doubles through it: host DLL TOKEN INPUTS OUTPUTS STEP_S FROM TO. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <windows.h>

#include "edp_fmi2.h"

typedef fmi2Component making(fmi2String, fmi2Type, fmi2String, fmi2String, const fmi2CallbackFunctions *, fmi2Boolean,
                             fmi2Boolean);
typedef fmi2Status simple(fmi2Component);
typedef fmi2Status setting(fmi2Component, const fmi2ValueReference *, size_t, const fmi2Real *);
typedef fmi2Status getting(fmi2Component, const fmi2ValueReference *, size_t, fmi2Real *);
typedef fmi2Status stepping(fmi2Component, fmi2Real, fmi2Real, fmi2Boolean);

static void tell(fmi2ComponentEnvironment e, fmi2String n, fmi2Status s, fmi2String c, fmi2String m, ...) {
    (void)e;
    (void)n;
    fprintf(stderr, "%d %s %s\n", (int)s, c, m);
}

#define FIND(type, name) type *const name = (type *)(void (*)(void))GetProcAddress(library, "fmi2" #name)

int main(int argc, char **argv) {
    const HMODULE library = (argc == 8) ? LoadLibraryA(argv[1]) : NULL;
    if (library == NULL) {
        return 2;
    }
    FIND(making, Instantiate);
    FIND(simple, EnterInitializationMode);
    FIND(simple, ExitInitializationMode);
    FIND(setting, SetReal);
    FIND(getting, GetReal);
    FIND(stepping, DoStep);
    const fmi2CallbackFunctions callbacks = {tell, NULL, NULL, NULL, NULL};
    const size_t inputs = (size_t)atoi(argv[3]), outputs = (size_t)atoi(argv[4]);
    const double size = atof(argv[5]);
    fmi2ValueReference refs[200];
    double values[200];
    for (unsigned i = 0; i < 200u; i++) {
        refs[i] = i;
    }
    const fmi2Component c = Instantiate("one", fmi2CoSimulation, argv[2], "", &callbacks, fmi2False, fmi2False);
    FILE *const from = fopen(argv[6], "rb"), *const to = fopen(argv[7], "wb");
    if ((c == NULL) || (from == NULL) || (to == NULL) || (inputs + outputs > 200u) ||
        (EnterInitializationMode(c) != fmi2OK) || (ExitInitializationMode(c) != fmi2OK)) {
        return 3;
    }
    for (int tick = 0; fread(values, sizeof(double), inputs, from) == inputs; tick++) {
        if ((SetReal(c, refs, inputs, values) != fmi2OK) || (DoStep(c, tick * size, size, fmi2True) > fmi2Warning) ||
            (GetReal(c, refs + inputs, outputs, values) != fmi2OK)) {
            return 4;
        }
        (void)fwrite(values, sizeof(double), outputs, to);
    }
    (void)fclose(to);
    return 0;
}
