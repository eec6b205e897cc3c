#include <stdint.h>
#define M2T(X) ((uint32_t)(X))
