#include "stabilizer_types.h"
void controllerMellingerFirmwareInit(void);
bool controllerMellingerFirmwareTest(void);
void controllerMellingerFirmware(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
                                 const state_t *state, const stabilizerStep_t stabilizerStep);
