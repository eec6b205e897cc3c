"""The names that other libraries have for the fields of a Config: the table of docs/glossary.md, in which unknown names are looked up.

`python -m lemniscate.run.glossary` prints the table for that page.
"""

import re
from collections.abc import Callable, Iterable

from lemniscate.errors import UserError, unknown_name

LIBRARIES = ("Stable-Baselines3", "CleanRL", "Spinning Up", "rsl_rl", "elsewhere")

FIELDS = """
`env` | `env` | `env_id` | `env_fn` | (environment's own) | `id`, `env_name`, `task`
`env_kwargs` | `env_kwargs` | – | – | – | `make_kwargs`
`wrappers` | `wrapper_class` | in `make_env` | – | – | `wrapper`
`num_envs` | `n_envs` | `num_envs` | `num_cpu` (processes) | (environment's own) | `num_workers`
`total_steps` | `total_timesteps` | `total_timesteps` | `epochs` × `steps_per_epoch` | `max_iterations` × T·N | `timesteps`, `n_timesteps`, `steps`, `max_steps`
`num_steps` of a rollout | `n_steps` | `num_steps` | `steps_per_epoch` / `num_cpu` | `num_steps_per_env` | `horizon`, `rollout_length`
`log_every` | `log_interval` (in episodes) | 100, fixed | `steps_per_epoch` | – | –
`epochs` | `n_epochs` | `update_epochs` | `train_pi_iters`, `train_v_iters` | `num_learning_epochs` | `num_epochs`
`minibatch_size` | `batch_size` | `num_minibatches` (the number of minibatches) | – | `num_mini_batches` (the number of minibatches) | –
`learning_rate` | `learning_rate` | `learning_rate` | `pi_lr` | `learning_rate` | `lr`, `step_size`
`final_learning_rate` | a schedule as learning_rate | `anneal_lr` (yes for 0, no for 1) | – | `schedule` (adaptive: see `desired_kl`) | `lr_schedule`
`adam_eps` | `policy_kwargs["optimizer_kwargs"]` | 1e-5, fixed | 1e-8, fixed | 1e-8, fixed | `eps`, `optimizer_eps`
`adam_beta2` | `policy_kwargs["optimizer_kwargs"]` | 0.999, fixed | 0.999, fixed | 0.999, fixed | `betas` (the second of the two)
`gamma` | `gamma` | `gamma` | `gamma` | `gamma` | `discount`, `discount_factor`
`gae_lambda` | `gae_lambda` | `gae_lambda` | `lam` | `lam` | `lambda`, `lambda_`
`clip` | `clip_range` | `clip_coef` | `clip_ratio` | `clip_param` | `clip_eps`, `epsilon`
`clip_value` | `clip_range_vf` (of the plain clipped error) | `clip_vloss` (yes or no, with `clip_coef`) | – | `use_clipped_value_loss` (yes or no, with `clip_param`) | `vf_clip_param`
`value_coef` | `vf_coef` (of a loss without ½) | `vf_coef` | – (two optimizers) | `value_loss_coef` (of a loss without ½) | `critic_coef`
`entropy_coef` | `ent_coef` | `ent_coef` | – | `entropy_coef` | `entropy_coeff`, `entropy_cost`
`normalize_advantage` | `normalize_advantage` | `norm_adv` | always, over the rollout | `normalize_advantage_per_mini_batch` (no: over the rollout) | `advantage_normalization`
`max_grad_norm` | `max_grad_norm` | `max_grad_norm` | – | `max_grad_norm` | `grad_clip`
`target_kl` (after each epoch) | `target_kl` (stops at 1.5 times it) | `target_kl` | `target_kl` (stops at 1.5 times it) | – | –
`desired_kl` | – | – | – | `desired_kl`, with `schedule` adaptive | `kl_target`
`recompute_advantages` | – | – | – | – | `recompute_advantage`
`scale_rewards` | `norm_reward` (of `VecNormalize`) | a wrapper, always | – | – | `normalize_rewards`, `reward_normalization`
`hidden` | `policy_kwargs["net_arch"]` | 64, 64, fixed | `hidden_sizes`, `ac_kwargs` | `hidden_dims`, `actor_hidden_dims` | `hid`, `layers`, `num_units`
`critic_hidden` | `policy_kwargs["net_arch"]["qf"]` | 256, 256, fixed | `hidden_sizes`, `ac_kwargs` | – | `critic_hidden_dims`
`activation` | `policy_kwargs["activation_fn"]` | tanh, fixed | `ac_kwargs["activation"]` | `activation` | `nonlinearity`
`network` | `policy`, `policy_kwargs` | – | `actor_critic` | `policy` | `architecture`, `model`
`initial_log_std` | `policy_kwargs["log_std_init"]` | 0, fixed | −0.5, fixed | `init_std` (not its logarithm), `init_noise_std` (not its logarithm) | `log_std`
`normalize_observations` | `norm_obs` (of `VecNormalize`) | a wrapper, always | – | `obs_normalization`, `empirical_normalization` | `normalize_obs`, `obs_norm`
`matmul` | – | – | – | – | `precision`, `amp`
`run` | `tensorboard_log` | `exp_name` | `exp_name`, `output_dir` | `log_dir` | `logdir`, `save_path`, `run_name`
`track` | – | `track` (yes or no) | – | `logger` | `wandb`, `use_wandb`
`callbacks` | `callback` | – | – | – | `hooks`
`seed` | `seed` | `seed` | `seed` | `seed` | `random_seed`
`backend` | `vec_env_cls` | – | – | (environment's own) | `simulator`
`device` | `device` | `cuda` | – | `device` | `gpu`
`shards` | – | – | – | – | `num_shards`
`threads` | torch.set_num_threads | the same | the same | – | `num_threads`
`compile` | – | LeanRL's `compile` | – | `torch_compile_mode` | `engine`, `torch_compile`, `jit`
`warm_start` | `set_parameters` | – | – | `load_run`, `resume` | `checkpoint`, `pretrained`
`checkpoint_every` | `save_freq` | `save_model` (at the end) | `save_freq` | `save_interval` | `checkpoint_freq`
`keep_checkpoints` | – | – | – | – | `max_to_keep`
`evaluate_every` | `eval_freq` | – | – | – | `eval_every`, `eval_interval`
`evaluate_episodes` | `n_eval_episodes` | – | – | – | `eval_episodes`, `num_eval_episodes`
`video_every` | `VecVideoRecorder` | `capture_video` | – | `video_interval` | `record_video`
`video_every_episodes` | – | – | – | – | `episode_trigger`
`buffer_size` | `buffer_size` | `buffer_size` | `replay_size` | – | `replay_capacity`, `capacity`, `memory_size`
`batch_size` | `batch_size` | `batch_size` | `batch_size` | – | `minibatch_size`
`learning_starts` | `learning_starts` | `learning_starts` | `start_steps`, `update_after` | – | `warmup_steps`
`update_every` | `train_freq` | 1, fixed | `update_every` | – | –
`num_updates` | `gradient_steps` | 1, fixed | `update_every` | – | `utd`, `updates_per_step`
`actor_learning_rate` | `learning_rate`, of both | `learning_rate`, `policy_lr` | `pi_lr` | – | `lr`, `actor_lr`
`critic_learning_rate` | `learning_rate`, of both | `learning_rate`, `q_lr` | `q_lr`, `vf_lr` | – | `lr`, `critic_lr`
`final_critic_learning_rate` | – | – | – | – | –
`tau` | `tau` | `tau` | `polyak` (1 − tau) | – | `target_update_rate`
`policy_delay` (policy and targets) | `policy_delay` | `policy_frequency` | `policy_delay` | – | `actor_update_interval`
`action_noise` | `action_noise` | Gaussian, fixed | Gaussian, fixed | – | `noise`, `exploration`
`noise_std` | `action_noise` | `exploration_noise` | `act_noise` | – | `sigma`, `expl_noise`
`noise_time` | `theta` (1 / noise_time) | – | – | – | `ou_theta` (1 / noise_time)
`noise_exponent` | – | – | – | – | `beta`
`target_noise` | `target_policy_noise` | `policy_noise` | `target_noise` | – | –
`target_noise_clip` | `target_noise_clip` | `noise_clip` | `noise_clip` | – | –
`target_entropy` none | `target_entropy` auto | `autotune` | – (fixed α) | – | –
`initial_temperature` | `ent_coef` (as auto_1.0) | `alpha` (fixed, unless autotune) | `alpha` (fixed) | – | `init_temperature`
`min_temperature` | – | – | – | – | `alpha_min`, `min_alpha`
`max_kl` | `target_kl` | – | `delta` | – | `kl_limit`
`td_lambda` | – | – | – | – | `lmbda`
`value_range` | – | – | – | – | `v_max`
`unit_weights` | – | – | – | – | –
`shrink` | `line_search_shrinking_factor` | – | `backtrack_coeff` | – | –
`attempts` | `line_search_max_iter` | – | `backtrack_iters` | – | –
`line_search` off | – | – | the algorithm npg | – | –
`cg_iterations` | `cg_max_steps` | – | `cg_iters` | – | –
`damping` | `cg_damping` | – | `damping_coeff` | – | –
`critic_epochs` | `n_critic_updates` | – | `train_v_iters` | – | –
`critic_minibatch_size` | `batch_size` | – | all rows | – | –
`episodes` | – | – | – | – | `num_episodes`, `episodes_per_update`
`returns` | – | – | – | – | `reward_to_go`
`baseline` | – | – | – | – | `use_baseline`
`standardize` | – | – | – | – | `standardize_returns`
"""
"""A row for each field: ours, then that of each library. What stands in backticks is looked up."""

GONE = {
    "population": "Population-based training has gone: `lemniscate tune` ends the worse trials early instead (--prune).",
}
"""names that earlier versions had, and what takes their place"""


def rows() -> list[tuple[str, ...]]:
    """The cells of each row: our field, and the other libraries' words for it."""
    return [tuple(cell.strip() for cell in line.split("|")) for line in FIELDS.strip().splitlines()]


def table() -> str:
    """The table in Markdown."""
    lines = [("field", *LIBRARIES), ("---",) * (1 + len(LIBRARIES)), *rows()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def words_of(library: str) -> str:
    """A table in Markdown of the fields that a library has a name for: its name, and the one here."""
    column = 1 + LIBRARIES.index(library)
    lines = [(library, "lemniscate"), ("---", "---"), *((row[column], row[0]) for row in rows() if "`" in row[column])]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def names_in(cell: str) -> list[str]:
    """The names in backticks: `a` gives a, and `a["b"]["c"]` a, b and c."""
    return [name for code in re.findall("`([^`]+)`", cell) for name in re.findall(r"\w+", code)]


def ours(name: str, known: Iterable[str]) -> dict[str, str]:
    """The fields among `known` that another library calls `name`, each with a remark where theirs means something else.

    A remark stands in brackets behind the name: `polyak` (1 − tau).
    """
    found: dict[str, str] = {}
    for field, *cells in rows():
        mine = names_in(field)[0]
        codes = re.findall(r"`([^`]+)`(?: \(([^)]*)\))?", " ".join(cells))
        remarks = [remark.replace("`", "") for code, remark in codes if name in re.findall(r"\w+", code)]
        if remarks and mine in known:
            found[mine] = min(remarks, key=len)
    return found


def unknown_field(name: str, known: Iterable[str], spell: Callable[[str], str] = str) -> UserError:
    """The sentence for a field that a Config does not have: ours for another library's word, or the nearest names.

    Args:
        name: the unknown field.
        known: the Config's fields.
        spell: how a name is written in the sentence, such as a flag.
    """
    if name in GONE:
        return UserError(GONE[name])
    known = list(known)
    found = ours(name, known)
    if not found:
        return unknown_name("field", spell(name), map(spell, known))
    here = " or ".join(spell(mine) + (f" (theirs: {remark})" if remark else "") for mine, remark in found.items())
    return UserError(f"There is no {spell(name)}: here it is {here}.")


if __name__ == "__main__":
    print(table())
