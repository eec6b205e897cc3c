/* Many observations with one call, for the tests on this machine; of a policy with a memory that is behind each, and
 * behind each action the next one. */
#include "policy.h"

#include <string.h>

int policy_act_rows(const float *obs, float *action, int rows);

int policy_act_rows(const float *obs, float *action, int rows)
{
    int row, flags = 0;
    for (row = 0; row < rows; ++row) {
#ifdef POLICY_MEMORY
        policy_state state;
        memcpy(state.memory, obs + POLICY_OBSERVATIONS, sizeof state.memory);
        flags += policy_act(&state, obs, action);
        memcpy(action + POLICY_ACTIONS, state.memory, sizeof state.memory);
        obs += POLICY_OBSERVATIONS + POLICY_MEMORY;
        action += POLICY_ACTIONS + POLICY_MEMORY;
#else
        flags += policy_act(obs, action);
        obs += POLICY_OBSERVATIONS;
        action += POLICY_ACTIONS;
#endif
    }
    return flags;
}
