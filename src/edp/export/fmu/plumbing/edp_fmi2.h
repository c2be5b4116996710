/* Types of FMI 2.0 (fmi-standard.org) as far as a co-simulation FMU needs them.
 *
 * With EDP_FMI_HEADERS the standard's own headers are taken instead. FMI2_FUNCTION_PREFIX, say `predictor_`, goes before
 * every function where several FMUs are linked into one program.
 */
#ifndef EDP_FMI2_H
#define EDP_FMI2_H

#define FMI2_PASTED(a, b) a##b
#define FMI2_WITH(a, b) FMI2_PASTED(a, b)

#ifdef EDP_FMI_HEADERS
#include "fmi2Functions.h"
#define FMI2_EXPORT FMI2_Export
#define FMI2(name) fmi2FullName(fmi2##name)
#else

#include <stddef.h>

#if defined(FMI2_FUNCTION_PREFIX)
#define FMI2_EXPORT
#define FMI2(name) FMI2_WITH(FMI2_FUNCTION_PREFIX, fmi2##name)
#else
#if defined(_WIN32)
#define FMI2_EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define FMI2_EXPORT __attribute__((visibility("default")))
#else
#define FMI2_EXPORT
#endif
#define FMI2(name) fmi2##name
#endif

typedef void *fmi2Component;
typedef void *fmi2ComponentEnvironment;
typedef void *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer;
typedef int fmi2Boolean;
typedef char fmi2Char;
typedef const fmi2Char *fmi2String;
typedef char fmi2Byte;

typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;

typedef void (*fmi2CallbackLogger)(fmi2ComponentEnvironment environment, fmi2String instance, fmi2Status status,
                                   fmi2String category, fmi2String message, ...);

typedef struct {
    fmi2CallbackLogger logger;
    void *(*allocateMemory)(size_t count, size_t size);
    void (*freeMemory)(void *memory);
    void (*stepFinished)(fmi2ComponentEnvironment environment, fmi2Status status);
    fmi2ComponentEnvironment componentEnvironment;
} fmi2CallbackFunctions;

#define fmi2True 1
#define fmi2False 0

#endif
#endif
