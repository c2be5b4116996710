/* A stand-in for what Simulink's cg_sfun.h and simulink.c do at the end of an S-function: one function that enters the
 * block's own ones into a SimStruct. EDP's own code. */
void S_FUNCTION_NAME(SimStruct *S);

void S_FUNCTION_NAME(SimStruct *S) {
    S->sizes = mdlInitializeSizes;
    S->times = mdlInitializeSampleTimes;
    S->start = mdlStart;
    S->initial = mdlInitializeConditions;
    S->tick = mdlOutputs;
    S->end = mdlTerminate;
}
