#define PARAM_UINT8 1
#define PARAM_RONLY 64
#define PARAM_GROUP_START(NAME) struct parameters_of_##NAME;
#define PARAM_ADD(TYPE, NAME, ADDRESS) extern void *const parameter_##NAME; void *const parameter_##NAME = ADDRESS;
#define PARAM_GROUP_STOP(NAME) struct parameters_of_##NAME;
