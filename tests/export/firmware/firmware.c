/* What the controller calls of the firmware, as far as a test looks at it; one call of it is `tick`. */
#include "FreeRTOS.h"
#include "app.h"
#include "commander.h"
#include "controller.h"
#include "controller_mellinger.h"
#include "power_distribution.h"
#include "task.h"

uint32_t silence;
setpoint_t followed;
static setpoint_t asked;
extern void *const parameter_on;
extern void *const parameter_fault;
int tick(const float state[14], int on, uint32_t step);
void last(float numbers[5]);

void vTaskDelay(uint32_t ticks) { (void)ticks; }
uint32_t commanderGetInactivityTime(void) { return silence; }
float powerDistributionGetMaxThrust(void) { return 0.6f; }
void controllerMellingerFirmwareInit(void) {}
bool controllerMellingerFirmwareTest(void) { return true; }

void controllerMellingerFirmware(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
                                 const state_t *state, const stabilizerStep_t stabilizerStep)
{
    (void)control, (void)sensors, (void)state, (void)stabilizerStep;
    followed = *setpoint;
}

/* position 3, quaternion 4, velocity 3, gyro in degrees 3, milliseconds since a setpoint; returns the fault */
int tick(const float state[14], int on, uint32_t step)
{
    control_t control = {0};
    sensorData_t sensors = {0};
    state_t s = {0};
    s.position = (point_t){0, state[0], state[1], state[2]};
    s.attitudeQuaternion = (quaternion_t){0, state[3], state[4], state[5], state[6]};
    s.velocity = (point_t){0, state[7], state[8], state[9]};
    sensors.gyro = (Axis3f){state[10], state[11], state[12]};
    silence = (uint32_t)state[13];
    *(uint8_t *)parameter_on = (uint8_t)on;
    asked.thrust = -1.0f;
    controllerOutOfTree(&control, &asked, &sensors, &s, step);
    return *(uint8_t *)parameter_fault;
}

/* the setpoint that was followed: thrust (-1 is the operator's own), roll, pitch, yaw, mode of yaw */
void last(float numbers[5])
{
    numbers[0] = followed.thrust;
    numbers[1] = followed.attitude.roll;
    numbers[2] = followed.attitude.pitch;
    numbers[3] = followed.attitude.yaw;
    numbers[4] = (float)followed.mode.yaw;
}
