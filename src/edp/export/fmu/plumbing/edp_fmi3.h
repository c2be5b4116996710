/* Types of FMI 3.0 (fmi-standard.org) as far as a co-simulation FMU needs them.
 *
 * With EDP_FMI_HEADERS the standard's own headers are taken instead. FMI3_FUNCTION_PREFIX, say `predictor_`, goes before
 * every function where several FMUs are linked into one program.
 */
#ifndef EDP_FMI3_H
#define EDP_FMI3_H

#define FMI3_PASTED(a, b) a##b
#define FMI3_WITH(a, b) FMI3_PASTED(a, b)

#ifdef EDP_FMI_HEADERS
#include "fmi3Functions.h"
#define FMI3_EXPORT FMI3_Export
#define FMI3(name) fmi3FullName(fmi3##name)
#else

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#if defined(FMI3_FUNCTION_PREFIX)
#define FMI3_EXPORT
#define FMI3(name) FMI3_WITH(FMI3_FUNCTION_PREFIX, fmi3##name)
#else
#if defined(_WIN32)
#define FMI3_EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define FMI3_EXPORT __attribute__((visibility("default")))
#else
#define FMI3_EXPORT
#endif
#define FMI3(name) fmi3##name
#endif

typedef void *fmi3Instance;
typedef void *fmi3InstanceEnvironment;
typedef void *fmi3FMUState;
typedef uint32_t fmi3ValueReference;
typedef float fmi3Float32;
typedef double fmi3Float64;
typedef int8_t fmi3Int8;
typedef uint8_t fmi3UInt8;
typedef int16_t fmi3Int16;
typedef uint16_t fmi3UInt16;
typedef int32_t fmi3Int32;
typedef uint32_t fmi3UInt32;
typedef int64_t fmi3Int64;
typedef uint64_t fmi3UInt64;
typedef bool fmi3Boolean;
typedef char fmi3Char;
typedef const fmi3Char *fmi3String;
typedef uint8_t fmi3Byte;
typedef const fmi3Byte *fmi3Binary;
typedef bool fmi3Clock;

typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef enum {
    fmi3Independent,
    fmi3Constant,
    fmi3Fixed,
    fmi3Tunable,
    fmi3Discrete,
    fmi3Dependent
} fmi3DependencyKind;
typedef enum { fmi3IntervalNotYetKnown, fmi3IntervalUnchanged, fmi3IntervalChanged } fmi3IntervalQualifier;

typedef void (*fmi3LogMessageCallback)(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                                       fmi3String message);
typedef void (*fmi3IntermediateUpdateCallback)(fmi3InstanceEnvironment environment, fmi3Float64 time,
                                               fmi3Boolean setRequested, fmi3Boolean getAllowed,
                                               fmi3Boolean stepFinished, fmi3Boolean canReturnEarly,
                                               fmi3Boolean *earlyReturnRequested, fmi3Float64 *earlyReturnTime);
typedef void (*fmi3ClockUpdateCallback)(fmi3InstanceEnvironment environment);
typedef void (*fmi3LockPreemptionCallback)(void);
typedef void (*fmi3UnlockPreemptionCallback)(void);

#endif
#endif
