/* $title
 *
 * Written by lemniscate $version; MIT licence. C99; no memory is allocated, and no number is a double.
 */
#include "policy.h"

#include <stdint.h>
#include <string.h>

$constants

static const float safe_action[POLICY_ACTIONS] = $safe;

static float scratch[$scratch];

$functions
static int is_finite(float x)
{
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits); /* a compiler that is told of no NaN, by -ffast-math, leaves this as it is */
    return (bits & 0x7F800000U) != 0x7F800000U;
}

int policy_act(const float obs[POLICY_OBSERVATIONS], float action[POLICY_ACTIONS])
{
    int i;
$arrays
    for (i = 0; i < POLICY_OBSERVATIONS; ++i) {
        if (!is_finite(obs[i])) {
            memcpy(action, safe_action, sizeof safe_action);
$masked            return 1;
        }
    }
$statements
    return 0;
}

static const float self_test_observations[POLICY_SELF_TESTS][POLICY_OBSERVATIONS] = {
$test_observations
};

static const float self_test_actions[POLICY_SELF_TESTS][POLICY_ACTIONS] = {
$test_actions
};

float policy_self_test(void)
{
    float action[POLICY_ACTIONS], difference, largest = 0.0F;
    int test, i;
    for (test = 0; test < POLICY_SELF_TESTS; ++test) {
        const int flag = policy_act(self_test_observations[test], action);
        for (i = 0; i < POLICY_ACTIONS; ++i) {
            difference = action[i] - self_test_actions[test][i];
            difference = difference < 0.0F ? -difference : difference;
            if (flag || !is_finite(difference)) {
                return 3.402823466e+38F;
            }
            largest = difference > largest ? difference : largest;
        }
    }
    return largest;
}
