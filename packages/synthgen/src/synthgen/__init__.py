"""Training pairs and test images for 6D pose refinement, rendered from a mesh."""

from posecore.renamed import refuse_renamed_modules

refuse_renamed_modules(
    {
        "synthgen.annotated": "synthgen.pairs.cut_plan",
        "synthgen.assets": "synthgen.inputs.assets",
        "synthgen.blender": "synthgen.engines.blender",
        "synthgen.bop.bopset": "synthgen.bop.dataset_writer",
        "synthgen.bop.framemaker": "synthgen.bop.frame_maker",
        "synthgen.bop.frames": "synthgen.bop.layout",
        "synthgen.bop.sequence": "synthgen.bop.motion",
        "synthgen.cli.console": "posecore.command_line",
        "synthgen.cli.group": "posecore.command_line",
        "synthgen.config.ranges": "posecore.config",
        "synthgen.cutter": "synthgen.pairs.cut",
        "synthgen.dataset": "synthgen.pairs.data_card",
        "synthgen.devices": "synthgen.engines.devices",
        "synthgen.draw.rest": "synthgen.draw.resting_pose",
        "synthgen.draw.sampling": "synthgen.draw.scene_draw",
        "synthgen.draw.streams": "synthgen.draw.random_streams",
        "synthgen.engines.make_engine": "synthgen.engines.make.make_engine",
        "synthgen.export": "synthgen.pairs.export",
        "synthgen.inspect.only": "synthgen.inspect.reproduce",
        "synthgen.merge": "synthgen.pairs.merge",
        "synthgen.pair": "synthgen.pairs.pair_maker",
        "synthgen.raster_engine": "synthgen.engines.raster",
        "synthgen.run.lock": "synthgen.lock",
        "synthgen.run.pipeline": "synthgen.run.dispatcher",
        "synthgen.run.scratch": "synthgen.engines.blender.scratch",
        "synthgen.run.shardrun": "synthgen.run.shard_job",
        "synthgen.sources": "synthgen.inputs.sources",
        "synthgen.verify.run": "synthgen.verify.verify",
    }
)
