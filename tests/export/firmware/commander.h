#include <stdint.h>
uint32_t commanderGetInactivityTime(void);
