            for (i = 0; i < $n; ++i) {
                const float permitted = obs[POLICY_OBSERVATIONS - $n + i];
                if (is_finite(permitted) && permitted != 0.0F) {
                    action[0] = (float)(i + $start);
                    break;
                }
            }
