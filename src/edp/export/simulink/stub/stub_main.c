/* Runs the S-function SFUN over rows from standard input: doubles as stub_run.h says; the argument is the sample time
 * in seconds. What a block complains of goes to standard error. EDP's own code. */
#include <stdio.h>

#include "stub_run.h"

void SFUN(SimStruct *S);

int main(int count, char **given) {
    static stub_run run;
    const char *error = stub_start(&run, SFUN, (count > 1) ? strtod(given[1], NULL) : 0.0);
    const size_t wide = (size_t)(HEAD + run.block[0].in[0].rows), made = (size_t)stub_outputs(&run.block[0]);
    real_T *const row = malloc(wide * sizeof *row), *const results = malloc(made * sizeof *results);
    while ((error == NULL) && (row != NULL) && (results != NULL) && (fread(row, sizeof *row, wide, stdin) == wide)) {
        error = stub_tick(&run, row, results);
        fwrite(results, sizeof *results, made, stdout);
    }
    if (error != NULL) {
        fprintf(stderr, "%s\n", error);
    }
    stub_end(&run);
    free(row);
    free(results);
    return (error != NULL) ? 1 : 0;
}
