/* Functions of FMI 3.0 that must be there although this FMU has no variables, clocks or modes of their kind. */
#include "edp_fmi3.h"

#include "edp_fmu.h"

static fmi3Status absent(fmi3Instance instance, const char *message) {
    return (instance == NULL) ? fmi3Error : (fmi3Status)edp_fmu_wrong((const edp_fmu *)instance, message);
}

/* All well if nothing was asked for. */
static fmi3Status none(fmi3Instance instance, size_t asked) {
    return ((instance != NULL) && (asked == 0u))
               ? fmi3OK
               : absent(instance, "there are no variables of this type: inputs and predictions are Float64");
}

#define REFERENCES fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences
#define NO_GETTER(Kind)                                                                                                \
    FMI3_EXPORT fmi3Status FMI3(Get##Kind)(REFERENCES, fmi3##Kind values[], size_t nValues) {                          \
        (void)valueReferences;                                                                                         \
        (void)values;                                                                                                  \
        return none(instance, nValueReferences + nValues);                                                             \
    }
#define NO_SETTER(Kind)                                                                                                \
    FMI3_EXPORT fmi3Status FMI3(Set##Kind)(REFERENCES, const fmi3##Kind values[], size_t nValues) {                    \
        (void)valueReferences;                                                                                         \
        (void)values;                                                                                                  \
        return none(instance, nValueReferences + nValues);                                                             \
    }

NO_GETTER(Float32)
NO_GETTER(Int8)
NO_GETTER(UInt8)
NO_GETTER(Int16)
NO_GETTER(UInt16)
NO_GETTER(UInt32)
NO_GETTER(Int64)
NO_GETTER(UInt64)
NO_GETTER(String)
NO_SETTER(Float32)
NO_SETTER(Int8)
NO_SETTER(UInt8)
NO_SETTER(Int16)
NO_SETTER(UInt16)
NO_SETTER(Int32)
NO_SETTER(UInt32)
NO_SETTER(Int64)
NO_SETTER(UInt64)
NO_SETTER(Boolean)
NO_SETTER(String)

FMI3_EXPORT fmi3Status FMI3(GetBinary)(REFERENCES, size_t valueSizes[], fmi3Binary values[], size_t nValues) {
    (void)valueReferences;
    (void)valueSizes;
    (void)values;
    return none(instance, nValueReferences + nValues);
}

FMI3_EXPORT fmi3Status FMI3(SetBinary)(REFERENCES, const size_t valueSizes[], const fmi3Binary values[],
                                       size_t nValues) {
    (void)valueReferences;
    (void)valueSizes;
    (void)values;
    return none(instance, nValueReferences + nValues);
}

FMI3_EXPORT fmi3Status FMI3(GetClock)(REFERENCES, fmi3Clock values[]) {
    (void)valueReferences;
    (void)values;
    return none(instance, nValueReferences);
}

FMI3_EXPORT fmi3Status FMI3(SetClock)(REFERENCES, const fmi3Clock values[]) {
    (void)valueReferences;
    (void)values;
    return none(instance, nValueReferences);
}

FMI3_EXPORT fmi3Status FMI3(GetIntervalDecimal)(REFERENCES, fmi3Float64 intervals[],
                                                fmi3IntervalQualifier qualifiers[]) {
    (void)valueReferences;
    (void)intervals;
    (void)qualifiers;
    return none(instance, nValueReferences);
}

FMI3_EXPORT fmi3Status FMI3(GetIntervalFraction)(REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
                                                 fmi3IntervalQualifier qualifiers[]) {
    (void)valueReferences;
    (void)counters;
    (void)resolutions;
    (void)qualifiers;
    return none(instance, nValueReferences);
}

FMI3_EXPORT fmi3Status FMI3(GetShiftDecimal)(REFERENCES, fmi3Float64 shifts[]) {
    (void)valueReferences;
    (void)shifts;
    return none(instance, nValueReferences);
}

FMI3_EXPORT fmi3Status FMI3(GetShiftFraction)(REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[]) {
    (void)valueReferences;
    (void)counters;
    (void)resolutions;
    return none(instance, nValueReferences);
}

FMI3_EXPORT fmi3Status FMI3(SetIntervalDecimal)(REFERENCES, const fmi3Float64 intervals[]) {
    (void)valueReferences;
    (void)intervals;
    return none(instance, nValueReferences);
}

FMI3_EXPORT fmi3Status FMI3(SetIntervalFraction)(REFERENCES, const fmi3UInt64 counters[],
                                                 const fmi3UInt64 resolutions[]) {
    (void)valueReferences;
    (void)counters;
    (void)resolutions;
    return none(instance, nValueReferences);
}

FMI3_EXPORT fmi3Status FMI3(SetShiftDecimal)(REFERENCES, const fmi3Float64 shifts[]) {
    (void)valueReferences;
    (void)shifts;
    return none(instance, nValueReferences);
}

FMI3_EXPORT fmi3Status FMI3(SetShiftFraction)(REFERENCES, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]) {
    (void)valueReferences;
    (void)counters;
    (void)resolutions;
    return none(instance, nValueReferences);
}

FMI3_EXPORT fmi3Status FMI3(GetOutputDerivatives)(REFERENCES, const fmi3Int32 orders[], fmi3Float64 values[],
                                                  size_t nValues) {
    (void)valueReferences;
    (void)orders;
    (void)values;
    return none(instance, nValueReferences + nValues);
}

FMI3_EXPORT fmi3Status FMI3(GetNumberOfVariableDependencies)(fmi3Instance instance, fmi3ValueReference valueReference,
                                                             size_t *nDependencies) {
    (void)valueReference;
    (void)nDependencies;
    return absent(instance, "modelDescription.xml has all dependencies");
}

FMI3_EXPORT fmi3Status FMI3(GetVariableDependencies)(fmi3Instance instance, fmi3ValueReference dependent,
                                                     size_t elementIndicesOfDependent[],
                                                     fmi3ValueReference independents[],
                                                     size_t elementIndicesOfIndependents[],
                                                     fmi3DependencyKind dependencyKinds[], size_t nDependencies) {
    (void)dependent;
    (void)elementIndicesOfDependent;
    (void)independents;
    (void)elementIndicesOfIndependents;
    (void)dependencyKinds;
    (void)nDependencies;
    return absent(instance, "modelDescription.xml has all dependencies");
}

FMI3_EXPORT fmi3Status FMI3(GetAdjointDerivative)(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                                  size_t nUnknowns, const fmi3ValueReference knowns[], size_t nKnowns,
                                                  const fmi3Float64 seed[], size_t nSeed, fmi3Float64 sensitivity[],
                                                  size_t nSensitivity) {
    (void)unknowns;
    (void)nUnknowns;
    (void)knowns;
    (void)nKnowns;
    (void)seed;
    (void)nSeed;
    (void)sensitivity;
    (void)nSensitivity;
    return absent(instance, "adjoint derivatives are not provided");
}

FMI3_EXPORT fmi3Status FMI3(EnterConfigurationMode)(fmi3Instance instance) {
    return absent(instance, "there is no configuration mode");
}

FMI3_EXPORT fmi3Status FMI3(ExitConfigurationMode)(fmi3Instance instance) {
    return absent(instance, "there is no configuration mode");
}

FMI3_EXPORT fmi3Status FMI3(EnterEventMode)(fmi3Instance instance) { return absent(instance, "there is no event mode"); }

FMI3_EXPORT fmi3Status FMI3(EnterStepMode)(fmi3Instance instance) { return absent(instance, "there is no event mode"); }

FMI3_EXPORT fmi3Status FMI3(EvaluateDiscreteStates)(fmi3Instance instance) {
    return absent(instance, "there is no event mode");
}

FMI3_EXPORT fmi3Status FMI3(UpdateDiscreteStates)(fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate,
                                                  fmi3Boolean *terminateSimulation,
                                                  fmi3Boolean *nominalsOfContinuousStatesChanged,
                                                  fmi3Boolean *valuesOfContinuousStatesChanged,
                                                  fmi3Boolean *nextEventTimeDefined, fmi3Float64 *nextEventTime) {
    (void)discreteStatesNeedUpdate;
    (void)terminateSimulation;
    (void)nominalsOfContinuousStatesChanged;
    (void)valuesOfContinuousStatesChanged;
    (void)nextEventTimeDefined;
    (void)nextEventTime;
    return absent(instance, "there is no event mode");
}

FMI3_EXPORT fmi3Instance FMI3(InstantiateModelExchange)(fmi3String instanceName, fmi3String instantiationToken,
                                                        fmi3String resourcePath, fmi3Boolean visible,
                                                        fmi3Boolean loggingOn,
                                                        fmi3InstanceEnvironment instanceEnvironment,
                                                        fmi3LogMessageCallback logMessage) {
    (void)instanceName;
    (void)instantiationToken;
    (void)resourcePath;
    (void)visible;
    (void)loggingOn;
    if (logMessage != NULL) {
        logMessage(instanceEnvironment, fmi3Error, "logStatusError", "this FMU is for co-simulation");
    }
    return NULL;
}

FMI3_EXPORT fmi3Instance FMI3(InstantiateScheduledExecution)(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath, fmi3Boolean visible,
    fmi3Boolean loggingOn, fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage,
    fmi3ClockUpdateCallback clockUpdate, fmi3LockPreemptionCallback lockPreemption,
    fmi3UnlockPreemptionCallback unlockPreemption) {
    (void)instanceName;
    (void)instantiationToken;
    (void)resourcePath;
    (void)visible;
    (void)loggingOn;
    (void)clockUpdate;
    (void)lockPreemption;
    (void)unlockPreemption;
    if (logMessage != NULL) {
        logMessage(instanceEnvironment, fmi3Error, "logStatusError", "this FMU is for co-simulation");
    }
    return NULL;
}

/* ---- of the other kinds of FMU: importers look them up, too ------------------------------------------------------------ */

#define NO_EXCHANGE absent(instance, "this FMU is for co-simulation")

FMI3_EXPORT fmi3Status FMI3(EnterContinuousTimeMode)(fmi3Instance instance) { return NO_EXCHANGE; }

FMI3_EXPORT fmi3Status FMI3(CompletedIntegratorStep)(fmi3Instance instance, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                                                     fmi3Boolean *enterEventMode, fmi3Boolean *terminateSimulation) {
    (void)noSetFMUStatePriorToCurrentPoint;
    (void)enterEventMode;
    (void)terminateSimulation;
    return NO_EXCHANGE;
}

FMI3_EXPORT fmi3Status FMI3(SetTime)(fmi3Instance instance, fmi3Float64 time) {
    (void)time;
    return NO_EXCHANGE;
}

FMI3_EXPORT fmi3Status FMI3(SetContinuousStates)(fmi3Instance instance, const fmi3Float64 continuousStates[],
                                                 size_t nContinuousStates) {
    (void)continuousStates;
    (void)nContinuousStates;
    return NO_EXCHANGE;
}

#define NO_NUMBERS(Name)                                                                                               \
    FMI3_EXPORT fmi3Status FMI3(Name)(fmi3Instance instance, fmi3Float64 numbers[], size_t n) {                        \
        (void)numbers;                                                                                                 \
        (void)n;                                                                                                       \
        return NO_EXCHANGE;                                                                                            \
    }
#define NO_NUMBER_OF(Name)                                                                                             \
    FMI3_EXPORT fmi3Status FMI3(Name)(fmi3Instance instance, size_t *n) {                                              \
        (void)n;                                                                                                       \
        return NO_EXCHANGE;                                                                                            \
    }

NO_NUMBERS(GetContinuousStateDerivatives)
NO_NUMBERS(GetEventIndicators)
NO_NUMBERS(GetContinuousStates)
NO_NUMBERS(GetNominalsOfContinuousStates)
NO_NUMBER_OF(GetNumberOfEventIndicators)
NO_NUMBER_OF(GetNumberOfContinuousStates)

FMI3_EXPORT fmi3Status FMI3(ActivateModelPartition)(fmi3Instance instance, fmi3ValueReference clockReference,
                                                    fmi3Float64 activationTime) {
    (void)clockReference;
    (void)activationTime;
    return NO_EXCHANGE;
}
