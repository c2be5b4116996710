/* FMI 3.0 for co-simulation around edp_fmu; functions of the standard that it has not are in edp_fmi3_absent.c. */
#include "edp_fmi3.h"

#include "edp_fmu.h"

#include <stdlib.h>
#include <string.h>

typedef struct {
    edp_fmu base; /* first: a pointer to one is a pointer to the other */
    fmi3LogMessageCallback logger;
    fmi3InstanceEnvironment environment;
} component;

static void tell(const edp_fmu *f, edp_fmu_status status, const char *category, const char *message) {
    const component *const c = (const component *)(const void *)f;
    if (c->logger != NULL) {
        c->logger(c->environment, (fmi3Status)status, category, message);
    }
}

static edp_fmu *of(fmi3Instance instance) { return (edp_fmu *)instance; }

/* ---- life ---------------------------------------------------------------------------------------------------------- */

FMI3_EXPORT const char *FMI3(GetVersion)(void) { return "3.0"; }

FMI3_EXPORT fmi3Instance FMI3(InstantiateCoSimulation)(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath, fmi3Boolean visible,
    fmi3Boolean loggingOn, fmi3Boolean eventModeUsed, fmi3Boolean earlyReturnAllowed,
    const fmi3ValueReference requiredIntermediateVariables[], size_t nRequiredIntermediateVariables,
    fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage,
    fmi3IntermediateUpdateCallback intermediateUpdate) {
    const char *why = edp_fmu_refused(instanceName, instantiationToken);
    component *made = NULL;
    (void)resourcePath;
    (void)visible;
    (void)earlyReturnAllowed;
    (void)requiredIntermediateVariables;
    (void)intermediateUpdate;
    if ((why == NULL) && (eventModeUsed || (nRequiredIntermediateVariables > 0u))) {
        why = "this FMU has neither an event mode nor intermediate variables";
    }
    if (why == NULL) {
        made = calloc(1u, sizeof *made);
        why = (made == NULL) ? "no memory for an instance" : NULL;
    }
    if (made != NULL) {
        made->logger = logMessage;
        made->environment = instanceEnvironment;
        made->base.tell = tell;
        made->base.talkative = loggingOn;
        edp_fmu_clear(&made->base);
    }
    if ((why != NULL) && (logMessage != NULL)) {
        logMessage(instanceEnvironment, fmi3Error, "logStatusError", why);
    }
    return made;
}

FMI3_EXPORT void FMI3(FreeInstance)(fmi3Instance instance) { free(instance); }

FMI3_EXPORT fmi3Status FMI3(SetDebugLogging)(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories,
                                             const fmi3String categories[]) {
    if (instance == NULL) {
        return fmi3Error;
    }
    for (size_t i = 0; i < nCategories; i++) {
        if ((strcmp(categories[i], "logStatusWarning") != 0) && (strcmp(categories[i], "logStatusError") != 0)) {
            return (fmi3Status)edp_fmu_wrong(of(instance),
                                             "the categories of messages are logStatusWarning and logStatusError");
        }
    }
    of(instance)->talkative = loggingOn;
    return fmi3OK;
}

FMI3_EXPORT fmi3Status FMI3(EnterInitializationMode)(fmi3Instance instance, fmi3Boolean toleranceDefined,
                                                     fmi3Float64 tolerance, fmi3Float64 startTime,
                                                     fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
    (void)toleranceDefined;
    (void)tolerance;
    (void)stopTimeDefined;
    (void)stopTime;
    return (instance == NULL) ? fmi3Error : (fmi3Status)edp_fmu_begin(of(instance), startTime);
}

FMI3_EXPORT fmi3Status FMI3(ExitInitializationMode)(fmi3Instance instance) {
    return (instance == NULL) ? fmi3Error : (fmi3Status)edp_fmu_ready(of(instance));
}

FMI3_EXPORT fmi3Status FMI3(Terminate)(fmi3Instance instance) {
    return (instance == NULL) ? fmi3Error : (fmi3Status)edp_fmu_end(of(instance));
}

FMI3_EXPORT fmi3Status FMI3(Reset)(fmi3Instance instance) {
    if (instance == NULL) {
        return fmi3Error;
    }
    edp_fmu_clear(of(instance));
    return fmi3OK;
}

FMI3_EXPORT fmi3Status FMI3(DoStep)(fmi3Instance instance, fmi3Float64 currentCommunicationPoint,
                                    fmi3Float64 communicationStepSize, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                                    fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation,
                                    fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
    (void)noSetFMUStatePriorToCurrentPoint;
    if (instance == NULL) {
        return fmi3Error;
    }
    const edp_fmu_status done = edp_fmu_step(of(instance), currentCommunicationPoint, communicationStepSize);
    *eventHandlingNeeded = false;
    *terminateSimulation = false;
    *earlyReturn = false;
    *lastSuccessfulTime = of(instance)->now.next;
    return (fmi3Status)done;
}

/* ---- values -------------------------------------------------------------------------------------------------------- */

/* Whether there are as many values as references: none of the variables is an array. */
static edp_fmu_status matched(fmi3Instance instance, size_t references, size_t values) {
    if (instance == NULL) {
        return EDP_FMU_ERROR;
    }
    return (references == values) ? EDP_FMU_OK
                                  : edp_fmu_wrong(of(instance), "there must be one value for each value reference");
}

FMI3_EXPORT fmi3Status FMI3(GetFloat64)(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                        size_t nValueReferences, fmi3Float64 values[], size_t nValues) {
    edp_fmu_status done = matched(instance, nValueReferences, nValues);
    for (size_t i = 0; (i < nValueReferences) && (done == EDP_FMU_OK); i++) {
        done = edp_fmu_get_real(of(instance), valueReferences[i], &values[i]);
    }
    return (fmi3Status)done;
}

FMI3_EXPORT fmi3Status FMI3(SetFloat64)(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                        size_t nValueReferences, const fmi3Float64 values[], size_t nValues) {
    edp_fmu_status done = matched(instance, nValueReferences, nValues);
    for (size_t i = 0; (i < nValueReferences) && (done == EDP_FMU_OK); i++) {
        done = edp_fmu_set_real(of(instance), valueReferences[i], values[i]);
    }
    return (fmi3Status)done;
}

FMI3_EXPORT fmi3Status FMI3(GetInt32)(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                      size_t nValueReferences, fmi3Int32 values[], size_t nValues) {
    edp_fmu_status done = matched(instance, nValueReferences, nValues);
    for (size_t i = 0; (i < nValueReferences) && (done == EDP_FMU_OK); i++) {
        done = edp_fmu_get_integer(of(instance), valueReferences[i], &values[i]);
    }
    return (fmi3Status)done;
}

FMI3_EXPORT fmi3Status FMI3(GetBoolean)(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                        size_t nValueReferences, fmi3Boolean values[], size_t nValues) {
    edp_fmu_status done = matched(instance, nValueReferences, nValues);
    for (size_t i = 0; (i < nValueReferences) && (done == EDP_FMU_OK); i++) {
        done = edp_fmu_get_flag(of(instance), valueReferences[i], &values[i]);
    }
    return (fmi3Status)done;
}

/* ---- saved states and derivatives ------------------------------------------------------------------------------------ */

FMI3_EXPORT fmi3Status FMI3(GetFMUState)(fmi3Instance instance, fmi3FMUState *FMUState) {
    if ((instance == NULL) || (FMUState == NULL)) {
        return fmi3Error;
    }
    edp_fmu_saved *kept = *FMUState;
    const edp_fmu_status done = edp_fmu_save(of(instance), &kept);
    *FMUState = kept;
    return (fmi3Status)done;
}

FMI3_EXPORT fmi3Status FMI3(SetFMUState)(fmi3Instance instance, fmi3FMUState FMUState) {
    return (instance == NULL) ? fmi3Error : (fmi3Status)edp_fmu_restore(of(instance), FMUState);
}

FMI3_EXPORT fmi3Status FMI3(FreeFMUState)(fmi3Instance instance, fmi3FMUState *FMUState) {
    (void)instance;
    if (FMUState != NULL) {
        free(*FMUState);
        *FMUState = NULL;
    }
    return fmi3OK;
}

FMI3_EXPORT fmi3Status FMI3(SerializedFMUStateSize)(fmi3Instance instance, fmi3FMUState FMUState, size_t *size) {
    (void)FMUState;
    *size = edp_fmu_bytes();
    return (instance == NULL) ? fmi3Error : fmi3OK;
}

FMI3_EXPORT fmi3Status FMI3(SerializeFMUState)(fmi3Instance instance, fmi3FMUState FMUState, fmi3Byte serializedState[],
                                               size_t size) {
    return (instance == NULL) ? fmi3Error : (fmi3Status)edp_fmu_write(of(instance), FMUState, serializedState, size);
}

FMI3_EXPORT fmi3Status FMI3(DeserializeFMUState)(fmi3Instance instance, const fmi3Byte serializedState[], size_t size,
                                                 fmi3FMUState *FMUState) {
    if ((instance == NULL) || (FMUState == NULL)) {
        return fmi3Error;
    }
    edp_fmu_saved *kept = NULL;
    const edp_fmu_status done = edp_fmu_read(of(instance), serializedState, size, &kept);
    *FMUState = kept;
    return (fmi3Status)done;
}

FMI3_EXPORT fmi3Status FMI3(GetDirectionalDerivative)(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                                      size_t nUnknowns, const fmi3ValueReference knowns[],
                                                      size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
                                                      fmi3Float64 sensitivity[], size_t nSensitivity) {
    float seeds[FMU_INPUTS] = {0.0f}, changes[FMU_OUTPUTS];
    edp_fmu_status done = matched(instance, nKnowns, nSeed);
    if (done == EDP_FMU_OK) {
        done = matched(instance, nUnknowns, nSensitivity);
    }
    for (size_t i = 0; (i < nKnowns) && (done == EDP_FMU_OK); i++) {
        done = edp_fmu_seed(of(instance), knowns[i], seed[i], seeds);
    }
    if (done == EDP_FMU_OK) {
        done = edp_fmu_derive(of(instance), seeds, changes);
    }
    for (size_t i = 0; (i < nUnknowns) && (done == EDP_FMU_OK); i++) {
        done = edp_fmu_change(of(instance), unknowns[i], changes, &sensitivity[i]);
    }
    return (fmi3Status)done;
}
