/* Many observations with one call, for the tests on this machine. */
#include "policy.h"

int policy_act_rows(const float *obs, float *action, int rows);

int policy_act_rows(const float *obs, float *action, int rows)
{
    int row, flags = 0;
    for (row = 0; row < rows; ++row) {
        flags += policy_act(obs + row * POLICY_OBSERVATIONS, action + row * POLICY_ACTIONS);
    }
    return flags;
}
