/* A stand-in for Simulink's simulink.c: makes a MEX function of an S-function that runs it over rows, for Octave.
 *
 *     results = NAME_sfun(rows, period)      see stub_run.h for the columns
 *
 * EDP's own code. */
#include "cg_sfun.h"
#include "mex.h"
#include "stub_run.h"

void mexFunction(int made, mxArray *result[], int count, const mxArray *given[]) {
    static stub_run run;
    const char *error;
    size_t ticks, wide, outputs;
    (void)made;
    if ((count != 2) || !mxIsDouble(given[0]) || !mxIsDouble(given[1])) {
        mexErrMsgIdAndTxt("edp:arguments", "rows and period, both double");
    }
    error = stub_start(&run, S_FUNCTION_NAME, mxGetScalar(given[1]));
    ticks = mxGetM(given[0]);
    wide = mxGetN(given[0]);
    outputs = (size_t)stub_outputs(&run.block[0]);
    if ((error == NULL) && (wide != (size_t)(HEAD + run.block[0].in[0].rows))) {
        error = "rows must be block, time, minor, reset and the measurements";
    }
    result[0] = mxCreateDoubleMatrix(ticks, outputs, mxREAL);
    if (error == NULL) {
        double *const row = mxMalloc(wide * sizeof *row), *const found = mxMalloc(outputs * sizeof *found);
        for (size_t tick = 0; (tick < ticks) && (error == NULL); tick++) {
            for (size_t at = 0; at < wide; at++) {
                row[at] = mxGetPr(given[0])[at * ticks + tick];
            }
            error = stub_tick(&run, row, found);
            for (size_t at = 0; at < outputs; at++) {
                mxGetPr(result[0])[at * ticks + tick] = found[at];
            }
        }
        mxFree(row);
        mxFree(found);
    }
    stub_end(&run);
    if (error != NULL) {
        mexErrMsgIdAndTxt("edp:sfun", "%s", error);
    }
}
