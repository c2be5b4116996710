/* A stand-in for the part of Simulink's simstruc.h that EDP's S-functions use, so that they compile and run without
 * Simulink. EDP's own code; it checks what Simulink would. Keep it off MATLAB's include path. */
#ifndef EDP_STUB_SIMSTRUC_H
#define EDP_STUB_SIMSTRUC_H

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef int int_T;
typedef unsigned char boolean_T;
typedef double real_T;
typedef double time_T;
typedef float real32_T;
typedef int32_t int32_T;
typedef uint32_t uint32_T;

enum { SS_DOUBLE = 0, SS_SINGLE = 1, SS_INT32 = 6, SS_UINT32 = 7, SS_BOOLEAN = 8 };
enum { COMPLEX_NO = 0, USE_DEFAULT_OPERATING_POINT = 1, DISALLOW_SAMPLE_TIME_INHERITANCE = 2 };
enum { SS_OPTION_EXCEPTION_FREE_CODE = 1, SS_OPTION_DISALLOW_CONSTANT_SAMPLE_TIME = 2 };
#define INHERITED_SAMPLE_TIME (-1.0)
#define STUB_MOST 8

typedef struct {
    int_T rows, columns, type, direct, contiguous;
    void *data;
} stub_signal;

typedef struct SimStruct_tag SimStruct;
struct SimStruct_tag {
    int_T inputs, outputs, works, parameters, sample_times, absolute_time, options;
    stub_signal in[STUB_MOST], out[STUB_MOST], work[STUB_MOST];
    real_T sample_time, offset, now;
    int_T minor;
    const char *error;
    void (*sizes)(SimStruct *);
    void (*times)(SimStruct *);
    void (*start)(SimStruct *);
    void (*initial)(SimStruct *);
    void (*tick)(SimStruct *, int_T);
    void (*end)(SimStruct *);
};

static inline int_T stub_ports(int_T *held, int_T count) {
    *held = count;
    return (count >= 0) && (count <= STUB_MOST);
}

static inline void stub_size(stub_signal *signal, int_T rows, int_T columns) {
    signal->rows = rows;
    signal->columns = columns;
}

#define ssSetNumSFcnParams(S, n) ((S)->parameters = (n))
#define ssGetNumSFcnParams(S) ((S)->parameters)
#define ssGetSFcnParamsCount(S) (0)
#define ssSetErrorStatus(S, text) ((S)->error = (text))
#define ssGetErrorStatus(S) ((S)->error)
#define ssSetNumInputPorts(S, n) stub_ports(&(S)->inputs, (n))
#define ssSetNumOutputPorts(S, n) stub_ports(&(S)->outputs, (n))
#define ssSetInputPortWidth(S, port, n) stub_size(&(S)->in[port], (n), 1)
#define ssSetInputPortDataType(S, port, kind) ((S)->in[port].type = (kind))
#define ssSetInputPortComplexSignal(S, port, kind) ((void)(S), (void)(port))
#define ssSetInputPortRequiredContiguous(S, port, yes) ((S)->in[port].contiguous = (yes))
#define ssSetInputPortDirectFeedThrough(S, port, yes) ((S)->in[port].direct = (yes))
#define ssSetOutputPortWidth(S, port, n) stub_size(&(S)->out[port], (n), 1)
#define ssSetOutputPortMatrixDimensions(S, port, m, n) stub_size(&(S)->out[port], (m), (n))
#define ssSetOutputPortDataType(S, port, kind) ((S)->out[port].type = (kind))
#define ssSetOutputPortComplexSignal(S, port, kind) ((void)(S), (void)(port))
#define ssSetNumSampleTimes(S, n) ((S)->sample_times = (n))
#define ssSetNumDWork(S, n) ((S)->works = (n))
#define ssSetDWorkWidth(S, at, n) stub_size(&(S)->work[at], (n), 1)
#define ssSetDWorkDataType(S, at, kind) ((S)->work[at].type = (kind))
#define ssSetNeedAbsoluteTime(S, yes) ((S)->absolute_time = (yes))
#define ssSetOperatingPointCompliance(S, kind) ((void)(S), (void)(kind))
#define ssSetOptions(S, set) ((S)->options = (set))
#define ssSetSampleTime(S, at, period) ((S)->sample_time = (period))
#define ssGetSampleTime(S, at) ((S)->sample_time)
#define ssSetOffsetTime(S, at, shift) ((S)->offset = (shift))
#define ssSetModelReferenceSampleTimeInheritanceRule(S, rule) ((void)(S), (void)(rule))
#define ssGetT(S) ((S)->now)
#define ssIsMajorTimeStep(S) (!(S)->minor)
#define ssGetDWork(S, at) ((S)->work[at].data)
#define ssGetInputPortSignal(S, port) ((const void *)(S)->in[port].data)
#define ssGetOutputPortSignal(S, port) ((S)->out[port].data)

#endif
