/* FMI 2.0 for co-simulation around edp_fmu. */
#include "edp_fmi2.h"

#include "edp_fmu.h"

#include <stdlib.h>
#include <string.h>

#define LONGEST 1600u

typedef struct {
    edp_fmu base; /* first: a pointer to one is a pointer to the other */
    fmi2CallbackLogger logger;
    fmi2ComponentEnvironment environment;
    char *name;
} component;

/* The importer takes the message as a format, so that a percent sign is written twice. */
static void log_to(fmi2CallbackLogger logger, fmi2ComponentEnvironment environment, const char *name, fmi2Status status,
                   const char *category, const char *message) {
    char text[LONGEST];
    size_t at = 0;
    for (const char *c = message; (*c != '\0') && (at + 2u < sizeof text); c++) {
        if (*c == '%') {
            text[at] = '%';
            at++;
        }
        text[at] = *c;
        at++;
    }
    text[at] = '\0';
    if (logger != NULL) {
        logger(environment, name, status, category, text);
    }
}

static void tell(const edp_fmu *f, edp_fmu_status status, const char *category, const char *message) {
    const component *const c = (const component *)(const void *)f;
    log_to(c->logger, c->environment, c->name, (fmi2Status)status, category, message);
}

static edp_fmu *of(fmi2Component c) { return (edp_fmu *)c; }

/* Calls that this FMU says it has not. */
static fmi2Status absent(fmi2Component c, const char *message) {
    return (c == NULL) ? fmi2Error : (fmi2Status)edp_fmu_wrong(of(c), message);
}

/* ---- life ---------------------------------------------------------------------------------------------------------- */

FMI2_EXPORT const char *FMI2(GetTypesPlatform)(void) { return "default"; }

FMI2_EXPORT const char *FMI2(GetVersion)(void) { return "2.0"; }

FMI2_EXPORT fmi2Component FMI2(Instantiate)(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                                            fmi2String fmuResourceLocation, const fmi2CallbackFunctions *functions,
                                            fmi2Boolean visible, fmi2Boolean loggingOn) {
    const char *why = edp_fmu_refused(instanceName, fmuGUID);
    const fmi2CallbackLogger logger = (functions != NULL) ? functions->logger : NULL;
    const fmi2ComponentEnvironment environment = (functions != NULL) ? functions->componentEnvironment : NULL;
    component *made = NULL;
    (void)fmuResourceLocation;
    (void)visible;
    if ((why == NULL) && (fmuType != fmi2CoSimulation)) {
        why = "this FMU is for co-simulation";
    }
    if (why == NULL) {
        made = calloc(1u, sizeof *made);
        char *const name = malloc(strlen(instanceName) + 1u);
        if ((made == NULL) || (name == NULL)) {
            why = "no memory for an instance";
            free(made);
            free(name);
            made = NULL;
        } else {
            made->name = strcpy(name, instanceName);
            made->logger = logger;
            made->environment = environment;
            made->base.tell = tell;
            made->base.talkative = loggingOn != fmi2False;
            edp_fmu_clear(&made->base);
        }
    }
    if (why != NULL) {
        log_to(logger, environment, (instanceName != NULL) ? instanceName : "", fmi2Error, "logStatusError", why);
    }
    return made;
}

FMI2_EXPORT void FMI2(FreeInstance)(fmi2Component c) {
    if (c != NULL) {
        free(((component *)c)->name);
        free(c);
    }
}

FMI2_EXPORT fmi2Status FMI2(SetDebugLogging)(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                                             const fmi2String categories[]) {
    if (c == NULL) {
        return fmi2Error;
    }
    for (size_t i = 0; i < nCategories; i++) {
        if ((strcmp(categories[i], "logStatusWarning") != 0) && (strcmp(categories[i], "logStatusError") != 0)) {
            return absent(c, "the categories of messages are logStatusWarning and logStatusError");
        }
    }
    of(c)->talkative = loggingOn != fmi2False;
    return fmi2OK;
}

FMI2_EXPORT fmi2Status FMI2(SetupExperiment)(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance,
                                             fmi2Real startTime, fmi2Boolean stopTimeDefined, fmi2Real stopTime) {
    (void)toleranceDefined;
    (void)tolerance;
    (void)stopTimeDefined;
    (void)stopTime;
    if (c == NULL) {
        return fmi2Error;
    }
    if (of(c)->now.mode != EDP_FMU_NEW) {
        return absent(c, "the experiment must be set up before the initialisation");
    }
    of(c)->now.next = startTime;
    return fmi2OK;
}

FMI2_EXPORT fmi2Status FMI2(EnterInitializationMode)(fmi2Component c) {
    return (c == NULL) ? fmi2Error : (fmi2Status)edp_fmu_begin(of(c), of(c)->now.next);
}

FMI2_EXPORT fmi2Status FMI2(ExitInitializationMode)(fmi2Component c) {
    return (c == NULL) ? fmi2Error : (fmi2Status)edp_fmu_ready(of(c));
}

FMI2_EXPORT fmi2Status FMI2(Terminate)(fmi2Component c) {
    return (c == NULL) ? fmi2Error : (fmi2Status)edp_fmu_end(of(c));
}

FMI2_EXPORT fmi2Status FMI2(Reset)(fmi2Component c) {
    if (c == NULL) {
        return fmi2Error;
    }
    edp_fmu_clear(of(c));
    return fmi2OK;
}

/* ---- steps --------------------------------------------------------------------------------------------------------- */

FMI2_EXPORT fmi2Status FMI2(DoStep)(fmi2Component c, fmi2Real currentCommunicationPoint, fmi2Real communicationStepSize,
                                    fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
    (void)noSetFMUStatePriorToCurrentPoint;
    return (c == NULL) ? fmi2Error
                       : (fmi2Status)edp_fmu_step(of(c), currentCommunicationPoint, communicationStepSize);
}

FMI2_EXPORT fmi2Status FMI2(CancelStep)(fmi2Component c) { return absent(c, "steps end at once: there is none to cancel"); }

FMI2_EXPORT fmi2Status FMI2(GetStatus)(fmi2Component c, const fmi2StatusKind s, fmi2Status *value) {
    (void)s;
    (void)value;
    return (c == NULL) ? fmi2Error : fmi2Discard; /* asked of steps that are pending only */
}

FMI2_EXPORT fmi2Status FMI2(GetRealStatus)(fmi2Component c, const fmi2StatusKind s, fmi2Real *value) {
    if (c == NULL) {
        return fmi2Error;
    }
    if (s != fmi2LastSuccessfulTime) {
        return fmi2Discard;
    }
    *value = of(c)->now.next;
    return fmi2OK;
}

FMI2_EXPORT fmi2Status FMI2(GetIntegerStatus)(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value) {
    (void)s;
    (void)value;
    return (c == NULL) ? fmi2Error : fmi2Discard;
}

FMI2_EXPORT fmi2Status FMI2(GetBooleanStatus)(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value) {
    if (c == NULL) {
        return fmi2Error;
    }
    if (s != fmi2Terminated) {
        return fmi2Discard;
    }
    *value = fmi2False;
    return fmi2OK;
}

FMI2_EXPORT fmi2Status FMI2(GetStringStatus)(fmi2Component c, const fmi2StatusKind s, fmi2String *value) {
    (void)s;
    (void)value;
    return (c == NULL) ? fmi2Error : fmi2Discard;
}

/* ---- values -------------------------------------------------------------------------------------------------------- */

FMI2_EXPORT fmi2Status FMI2(GetReal)(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[]) {
    edp_fmu_status done = (c == NULL) ? EDP_FMU_ERROR : EDP_FMU_OK;
    for (size_t i = 0; (i < nvr) && (done == EDP_FMU_OK); i++) {
        done = edp_fmu_get_real(of(c), vr[i], &value[i]);
    }
    return (fmi2Status)done;
}

FMI2_EXPORT fmi2Status FMI2(SetReal)(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                     const fmi2Real value[]) {
    edp_fmu_status done = (c == NULL) ? EDP_FMU_ERROR : EDP_FMU_OK;
    for (size_t i = 0; (i < nvr) && (done == EDP_FMU_OK); i++) {
        done = edp_fmu_set_real(of(c), vr[i], value[i]);
    }
    return (fmi2Status)done;
}

FMI2_EXPORT fmi2Status FMI2(GetInteger)(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        fmi2Integer value[]) {
    edp_fmu_status done = (c == NULL) ? EDP_FMU_ERROR : EDP_FMU_OK;
    for (size_t i = 0; (i < nvr) && (done == EDP_FMU_OK); i++) {
        int32_t whole = 0;
        done = edp_fmu_get_integer(of(c), vr[i], &whole);
        value[i] = (fmi2Integer)whole;
    }
    return (fmi2Status)done;
}

FMI2_EXPORT fmi2Status FMI2(GetBoolean)(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        fmi2Boolean value[]) {
    edp_fmu_status done = (c == NULL) ? EDP_FMU_ERROR : EDP_FMU_OK;
    for (size_t i = 0; (i < nvr) && (done == EDP_FMU_OK); i++) {
        bool flag = false;
        done = edp_fmu_get_flag(of(c), vr[i], &flag);
        value[i] = flag ? fmi2True : fmi2False;
    }
    return (fmi2Status)done;
}

FMI2_EXPORT fmi2Status FMI2(GetString)(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2String value[]) {
    (void)vr;
    (void)value;
    return ((c != NULL) && (nvr == 0u)) ? fmi2OK : absent(c, "there are no variables of text");
}

FMI2_EXPORT fmi2Status FMI2(SetInteger)(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer value[]) {
    (void)vr;
    (void)value;
    return ((c != NULL) && (nvr == 0u)) ? fmi2OK : absent(c, "inputs are real variables");
}

FMI2_EXPORT fmi2Status FMI2(SetBoolean)(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Boolean value[]) {
    (void)vr;
    (void)value;
    return ((c != NULL) && (nvr == 0u)) ? fmi2OK : absent(c, "inputs are real variables");
}

FMI2_EXPORT fmi2Status FMI2(SetString)(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2String value[]) {
    (void)vr;
    (void)value;
    return ((c != NULL) && (nvr == 0u)) ? fmi2OK : absent(c, "inputs are real variables");
}

FMI2_EXPORT fmi2Status FMI2(SetRealInputDerivatives)(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                                     const fmi2Integer order[], const fmi2Real value[]) {
    (void)vr;
    (void)order;
    (void)value;
    return ((c != NULL) && (nvr == 0u)) ? fmi2OK : absent(c, "inputs are held during a step, not interpolated");
}

FMI2_EXPORT fmi2Status FMI2(GetRealOutputDerivatives)(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                                      const fmi2Integer order[], fmi2Real value[]) {
    (void)vr;
    (void)order;
    (void)value;
    return ((c != NULL) && (nvr == 0u)) ? fmi2OK : absent(c, "outputs have no derivatives by time");
}

/* ---- saved states and derivatives ------------------------------------------------------------------------------------ */

FMI2_EXPORT fmi2Status FMI2(GetFMUstate)(fmi2Component c, fmi2FMUstate *FMUstate) {
    if ((c == NULL) || (FMUstate == NULL)) {
        return fmi2Error;
    }
    edp_fmu_saved *kept = *FMUstate;
    const edp_fmu_status done = edp_fmu_save(of(c), &kept);
    *FMUstate = kept;
    return (fmi2Status)done;
}

FMI2_EXPORT fmi2Status FMI2(SetFMUstate)(fmi2Component c, fmi2FMUstate FMUstate) {
    return (c == NULL) ? fmi2Error : (fmi2Status)edp_fmu_restore(of(c), FMUstate);
}

FMI2_EXPORT fmi2Status FMI2(FreeFMUstate)(fmi2Component c, fmi2FMUstate *FMUstate) {
    (void)c;
    if (FMUstate != NULL) {
        free(*FMUstate);
        *FMUstate = NULL;
    }
    return fmi2OK;
}

FMI2_EXPORT fmi2Status FMI2(SerializedFMUstateSize)(fmi2Component c, fmi2FMUstate FMUstate, size_t *size) {
    (void)FMUstate;
    *size = edp_fmu_bytes();
    return (c == NULL) ? fmi2Error : fmi2OK;
}

FMI2_EXPORT fmi2Status FMI2(SerializeFMUstate)(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[],
                                               size_t size) {
    return (c == NULL) ? fmi2Error : (fmi2Status)edp_fmu_write(of(c), FMUstate, serializedState, size);
}

FMI2_EXPORT fmi2Status FMI2(DeSerializeFMUstate)(fmi2Component c, const fmi2Byte serializedState[], size_t size,
                                                 fmi2FMUstate *FMUstate) {
    if ((c == NULL) || (FMUstate == NULL)) {
        return fmi2Error;
    }
    edp_fmu_saved *kept = NULL;
    const edp_fmu_status done = edp_fmu_read(of(c), serializedState, size, &kept);
    *FMUstate = kept;
    return (fmi2Status)done;
}

FMI2_EXPORT fmi2Status FMI2(GetDirectionalDerivative)(fmi2Component c, const fmi2ValueReference vUnknown_ref[],
                                                      size_t nUnknown, const fmi2ValueReference vKnown_ref[],
                                                      size_t nKnown, const fmi2Real dvKnown[], fmi2Real dvUnknown[]) {
    float seeds[FMU_INPUTS] = {0.0f}, changes[FMU_OUTPUTS];
    edp_fmu_status done = (c == NULL) ? EDP_FMU_ERROR : EDP_FMU_OK;
    for (size_t i = 0; (i < nKnown) && (done == EDP_FMU_OK); i++) {
        done = edp_fmu_seed(of(c), vKnown_ref[i], dvKnown[i], seeds);
    }
    if (done == EDP_FMU_OK) {
        done = edp_fmu_derive(of(c), seeds, changes);
    }
    for (size_t i = 0; (i < nUnknown) && (done == EDP_FMU_OK); i++) {
        done = edp_fmu_change(of(c), vUnknown_ref[i], changes, &dvUnknown[i]);
    }
    return (fmi2Status)done;
}
