"""Configuration keys and values of earlier versions, as tables for `posecore.renamed`."""

RENAMED = {
    "own_predictions": "on_policy",
    "own_predictions.share": "on_policy.fraction",
    "own_predictions.begin": "on_policy.begin",
    "own_predictions.full": "on_policy.full",
    "own_predictions.updates": "on_policy.updates",
    "hypothesis.fresh": "hypothesis.online",
    "hypothesis.easy_share": "hypothesis.easy_fraction",
    "hypothesis.stored_share": "hypothesis.precomputed_fraction",
    "hypothesis.any_twin": "hypothesis.sample_symmetries",
    "augment.occlusion_leaves": "augment.min_visible_fraction",
    "loss.min_closeness": "loss.min_pose_quality",
    "loss.confidence_target=overlap": "loss.confidence_target=visible_iou",
    "loss.confidence_target=closeness": "loss.confidence_target=pose_quality",
    "validation.scene_share": "validation.scene_fraction",
}
"""Old name to new name: refused in new configurations, migrated in old checkpoints."""
