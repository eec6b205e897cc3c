
#define HISTORY $steps /* steps before this one that are observed too */

static float past[HISTORY][$size]; /* what was observed and done then, the newest first */

static void remember(const float *obs, const float *action)
{
    for (int i = HISTORY - 1; i > 0; --i) {
        memcpy(past[i], past[i - 1], sizeof past[0]);
    }
$remembered
}

static void recall(float *obs)
{
    static const float before[POLICY_ACTIONS] = {$before}; /* as if it had hovered here */
    if (!acting) {
        for (int i = 0; i < HISTORY; ++i) {
            remember(obs, before);
        }
    }
    for (int i = 0; i < HISTORY; ++i) {
        float *const then = obs + $first + $size * i;
$recalled
    }
}
