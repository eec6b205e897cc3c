/* {{ title | comment }}
 *
 * Written by lemniscate {{ version }}; MIT licence. C99; no memory is allocated, and no number is a double.
 */
#include "policy.h"

#include <stdint.h>
#include <string.h>

{{ body.constants | join("\n\n") }}

static const float safe_action[POLICY_ACTIONS] = {{ safe | braces }};

{% if body.scratch %}
static float scratch[{{ body.scratch }}];
{% endif %}

{{ body.statements | join("\n") | functions }}
static int is_finite(float x)
{
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits); /* a compiler that is told of no NaN, by -ffast-math, leaves this as it is */
    return (bits & 0x7F800000U) != 0x7F800000U;
}

{% if program.memory %}
void policy_reset(policy_state *state)
{
    memset(state, 0, sizeof *state);
}

int policy_act(policy_state *state, const float obs[POLICY_OBSERVATIONS], float action[POLICY_ACTIONS])
{
    float *const memory = state->memory;
{% else %}
int policy_act(const float obs[POLICY_OBSERVATIONS], float action[POLICY_ACTIONS])
{
{% endif %}
    int i;
{% for name, place in body.places.items() %}
    float *const {{ name }} = scratch + {{ place }};
{% endfor %}
    for (i = 0; i < POLICY_OBSERVATIONS; ++i) {
        if (!is_finite(obs[i])) {
            memcpy(action, safe_action, sizeof safe_action);
{% set behind = namespace(size=action.mask_size) %}
{% for n, first in masked %}
            for (i = 0; i < {{ n }}; ++i) {
                const float permitted = obs[POLICY_OBSERVATIONS - {{ behind.size }} + i];
                if (is_finite(permitted) && permitted != 0.0F) {
                    action[{{ loop.index0 }}] = (float)(i + {{ first }});
                    break;
                }
            }
{% set behind.size = behind.size - n %}
{% endfor %}
            return 1;
        }
    }
{% for statement in body.statements %}
    {{ statement }}
{% endfor %}
    return 0;
}

static const float self_test_observations[POLICY_SELF_TESTS][POLICY_OBSERVATIONS] = {
{% for row in observations %}
    {{ row[:program.obs.size] | braces }},
{% endfor %}
};

static const float self_test_actions[POLICY_SELF_TESTS][POLICY_ACTIONS] = {
{% for row in actions %}
    {{ row[:program.action.size] | braces }},
{% endfor %}
};

static const float self_test_units[POLICY_ACTIONS] = {{ units | braces }};
{% if program.memory %}

static const float self_test_memories[POLICY_SELF_TESTS][POLICY_MEMORY] = { /* before */
{% for row in observations %}
    {{ row[program.obs.size:] | braces }},
{% endfor %}
};

static const float self_test_afters[POLICY_SELF_TESTS][POLICY_MEMORY] = {
{% for row in actions %}
    {{ row[program.action.size:] | braces }},
{% endfor %}
};
{% endif %}

static float further(float largest, float one, float other, float unit)
{
    float difference = (one - other) / unit;
    difference = difference < 0.0F ? -difference : difference;
    if (!is_finite(difference)) {
        return 3.402823466e+38F;
    }
    return difference > largest ? difference : largest;
}

float policy_self_test(void)
{
    float action[POLICY_ACTIONS], largest = 0.0F;
    int test, i;
    for (test = 0; test < POLICY_SELF_TESTS; ++test) {
{% if program.memory %}
        policy_state state;
        memcpy(state.memory, self_test_memories[test], sizeof state.memory);
        if (policy_act(&state, self_test_observations[test], action)) {
            return 3.402823466e+38F;
        }
        for (i = 0; i < POLICY_MEMORY; ++i) {
            largest = further(largest, state.memory[i], self_test_afters[test][i], 1.0F);
        }
{% else %}
        if (policy_act(self_test_observations[test], action)) {
            return 3.402823466e+38F;
        }
{% endif %}
        for (i = 0; i < POLICY_ACTIONS; ++i) {
            largest = further(largest, action[i], self_test_actions[test][i], self_test_units[i]);
        }
    }
    return largest;
}
