/* {{ title | comment }}
 *
 * Written by lemniscate {{ version }}; MIT licence. manifest.json says what each number means.
 */
#ifndef POLICY_H
#define POLICY_H

#ifdef __cplusplus
extern "C" {
#endif

#define POLICY_OBSERVATIONS {{ program.obs.size }}
#define POLICY_ACTIONS {{ program.action.size }}
{% if program.memory %}
#define POLICY_MEMORY {{ program.memory.size }}
{% endif %}
{% if period %}
#define POLICY_PERIOD {{ period }}F /* seconds between two actions */
{% endif %}
#define POLICY_SELF_TESTS {{ observations | length }}
#define POLICY_SELF_TEST_BOUND {{ bound }}

{% if wrappers %}
/* NOT IN THIS FILE: the wrappers of training, {{ wrappers | join(", ") | comment }}.
 * `obs` is what the last of them returns, and `action` goes into it; what they do is to be done around policy_act. */

{% endif %}
{% if program.memory %}
/* What the policy remembers of an episode; several may be under way at once. */
typedef struct {
    float memory[POLICY_MEMORY];
} policy_state;

/* Forgets: before the first observation of each episode. */
void policy_reset(policy_state *state);

{% endif %}
/* Acts at one raw observation, in the manifest's order; `action` is in the units of the environment. Returns 0, or 1
 * where an observation is NaN or infinite: the action is then the safe one,
 * {{ safe_sentence }}{% if program.memory %}, and the memory stays as it is{% endif %}.
 * Takes the same time at every finite observation. Not reentrant: it has one static array of scratch. */
{% if program.memory %}
int policy_act(policy_state *state, const float obs[POLICY_OBSERVATIONS], float action[POLICY_ACTIONS]);
{% else %}
int policy_act(const float obs[POLICY_OBSERVATIONS], float action[POLICY_ACTIONS]);
{% endif %}

/* The largest difference from the actions of training's own policy, at POLICY_SELF_TESTS observations that are stored
 * beside the weights: {{ origin | comment }}.
{% if program.memory %}
 * So are memories before and after each, whose differences count too.
{% endif %}
{% if is_box %}
 * Differences are shares of half the range of each action; where a bound is infinite, of its unit, or of its largest
 * value above 1.
{% endif %}
 * It is below POLICY_SELF_TEST_BOUND where compiler and memory do as they should. A program that does not call it does
 * not carry them, if it is linked with -ffunction-sections -fdata-sections -Wl,--gc-sections. */
float policy_self_test(void);

#ifdef __cplusplus
}
#endif

#endif
