/* SPDX-License-Identifier: GPL-3.0-only
 *
 * {{ title | comment }}
 *
 * An out-of-tree controller for the Crazyflie's firmware, written by lemniscate {{ version }}. This file alone is under the
 * GNU General Public License, version 3, since it is linked with the firmware's own functions; policy.c and policy.h
 * are not.
 *
 * The policy commands attitude and thrust {{ rate }} times a second; the firmware's Mellinger controller holds them. It acts
 * only while all of these are so, and else the Mellinger controller follows the setpoints as ever:
 *   - the parameter policy.on is 1;
 *   - a setpoint has come within the last DEAD_MAN_MS milliseconds: who lets go of the sender stops the policy;
 *   - there was no fault since policy.on was 0: an observation that is not finite, or a tilt beyond 60 degrees.
 */
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#include "FreeRTOS.h"
#include "app.h"
#include "commander.h"
#include "controller.h"
#include "controller_mellinger.h"
#include "param.h"
#include "policy.h"
#include "power_distribution.h"
#include "stabilizer_types.h"
#include "task.h"

#define DEAD_MAN_MS 200
#define POLICY_RATE {{ rate }}
#define DEGREES (180.0f / 3.14159265f)
#define RADIANS (3.14159265f / 180.0f)
{% if reference %}

#define REFERENCE_STEPS {{ reference.points | length }}
#define REFERENCE_SAMPLES {{ reference.offsets | length }}

static const float reference[REFERENCE_STEPS][3] = { /* m, in the world */
{% for point in reference.points %}
    { {{- point.tolist() | map("literal") | join(", ") -}} }{{ "," if not loop.last }}
{% endfor %}
};

static const uint32_t ahead[REFERENCE_SAMPLES] = { {{- reference.offsets | join(", ") -}} }; /* steps */
{% endif %}

static uint8_t on;
static uint8_t fault;
static bool acting;
{% if remembers %}
static policy_state remembered;
{% endif %}
{% if reference %}
static uint32_t step; /* the point of the curve */
{% endif %}

static void observe(float *obs, const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state)
{
{% for unread in ("setpoint", "sensors") if unread not in sensed.values() | join %}
    (void){{ unread }};
{% endfor %}
{% for i, expression in sensed.items() %}
    obs[{{ i }}] = {{ expression }};
{% endfor %}
{% if to_reference is not none %}
    for (int i = 0; i < REFERENCE_SAMPLES; ++i) {
        const float *const point = reference[(step + ahead[i]) % REFERENCE_STEPS];
{% for axis in "xyz" %}
        obs[{{ to_reference + loop.index0 }} + 3 * i] = point[{{ loop.index0 }}] - state->position.{{ axis }};
{% endfor %}
    }
{% endif %}
}
{% if kept %}

#define HISTORY {{ interface.history }} /* steps before this one that are observed too */

static float past[HISTORY][{{ kept | length }}]; /* what was observed and done then, the newest first */

static void remember(const float *obs, const float *action)
{
    for (int i = HISTORY - 1; i > 0; --i) {
        memcpy(past[i], past[i - 1], sizeof past[0]);
    }
{% for now, coordinate in kept %}
    past[0][{{ loop.index0 }}] = {{ now or coordinate }};
{% endfor %}
}

static void recall(float *obs)
{
    static const float before[POLICY_ACTIONS] = { {{- interface.action_before | map("literal") | join(", ") -}} }; /* as if it had hovered here */
    if (!acting) {
        for (int i = 0; i < HISTORY; ++i) {
            remember(obs, before);
        }
    }
    for (int i = 0; i < HISTORY; ++i) {
        float *const then = obs + {{ first }} + {{ kept | length }} * i;
{% for now, _ in kept %}
        then[{{ loop.index0 }}] = past[i][{{ loop.index0 }}]{{ " - " ~ now if now }};
{% endfor %}
    }
}
{% endif %}

static void command(setpoint_t *setpoint, const float *action)
{
    memset(setpoint, 0, sizeof *setpoint); /* no position is held: modeDisable is 0 */
    setpoint->mode.roll = modeAbs;
    setpoint->mode.pitch = modeAbs;
    setpoint->mode.yaw = modeAbs;
    setpoint->attitude.roll = action[0] * DEGREES;
    setpoint->attitude.pitch = -action[1] * DEGREES; /* the firmware's setpoints have this axis turned round */
    setpoint->attitude.yaw = action[2] * DEGREES;
    setpoint->thrust = action[3] / powerDistributionGetMaxThrust() * (float)UINT16_MAX;
}

static bool is_upright(const state_t *state)
{
    const float x = state->attitudeQuaternion.x, y = state->attitudeQuaternion.y;
    return 1.0f - 2.0f * (x * x + y * y) > 0.5f; /* the cosine of the tilt; false for NaN */
}

static bool may_act(const state_t *state)
{
    if (!on) {
        fault = 0;
        return false;
    }
    if (!is_upright(state)) {
        fault = 1;
    }
    return !fault && commanderGetInactivityTime() < M2T(DEAD_MAN_MS);
}

void appMain(void)
{
    for (;;) {
        vTaskDelay(M2T(1000)); /* the application has nothing to do; the stabilizer calls the functions below */
    }
}

void controllerOutOfTreeInit(void)
{
    on = 0;
    acting = false;
    controllerMellingerFirmwareInit();
}

bool controllerOutOfTreeTest(void)
{
    return policy_self_test() < POLICY_SELF_TEST_BOUND && controllerMellingerFirmwareTest();
}

void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
                         const state_t *state, const stabilizerStep_t stabilizerStep)
{
    static float obs[POLICY_OBSERVATIONS], action[POLICY_ACTIONS];
    static setpoint_t commanded;
    bool acts = may_act(state);
    if (acts && (!acting || RATE_DO_EXECUTE(POLICY_RATE, stabilizerStep))) {
{% if reference %}
        step = acting ? (step + 1) % REFERENCE_STEPS : REFERENCE_STEPS - 1;
{% endif %}
        observe(obs, setpoint, sensors, state);
{% if kept %}
        recall(obs);
{% endif %}
{% if remembers %}
        if (!acting) {
            policy_reset(&remembered);
        }
        fault = policy_act(&remembered, obs, action) != 0;
{% else %}
        fault = policy_act(obs, action) != 0;
{% endif %}
{% if kept %}
        remember(obs, action);
{% endif %}
        acts = !fault;
        command(&commanded, action);
    }
    acting = acts;
    controllerMellingerFirmware(control, acting ? &commanded : setpoint, sensors, state, stabilizerStep);
}

PARAM_GROUP_START(policy)
PARAM_ADD(PARAM_UINT8, on, &on)
PARAM_ADD(PARAM_UINT8 | PARAM_RONLY, fault, &fault)
PARAM_GROUP_STOP(policy)
