"""Render settings of Cycles and EEVEE for small pictures: all options with a cost per picture are off."""

import bpy

from synthgen.engines.blender.devices import gpu_counts, use_gpus
from synthgen.engines.blender.materials import INDEX_AOV
from synthgen.engines.devices import choose_device
from synthgen.names import Device

ENGINE_IDS = {"cycles": "CYCLES", "eevee": "BLENDER_EEVEE_NEXT"}
COLOUR_FILTER_PX = 1.5


def set_common(scene: bpy.types.Scene, *, engine: str, threads: int) -> None:
    """Set the common options of both engines: linear float EXR with alpha, no post-processing.

    Args:
        scene: Blender's scene.
        engine: 'cycles' or 'eevee'.
        threads: Threads to render with, 0 for all cores.
    """
    render = scene.render
    render.engine = ENGINE_IDS[engine]
    render.use_persistent_data = True
    render.film_transparent = True
    render.filter_size = COLOUR_FILTER_PX
    render.resolution_percentage = 100
    render.use_file_extension = False
    render.use_overwrite = True
    render.use_compositing = False
    render.use_sequencer = False
    render.use_motion_blur = False
    render.dither_intensity = 0.0
    render.threads_mode = "FIXED" if threads else "AUTO"
    if threads:
        render.threads = threads
    image = render.image_settings
    image.file_format = "OPEN_EXR_MULTILAYER"
    image.color_mode = "RGBA"
    image.color_depth = "32"
    image.exr_codec = "NONE"
    scene.view_settings.view_transform = "Raw"
    scene.view_settings.look = "None"
    scene.view_layers[0].use_pass_combined = True
    scene.view_layers[0].use_pass_z = True


def set_cycles(scene: bpy.types.Scene, *, device: Device) -> None:
    """Set Cycles to few samples and short paths, with the same result on any number of threads.

    Args:
        scene: Blender's scene.
        device: Device; 'auto' takes the first available one of OptiX, CUDA and the CPU.

    Raises:
        RenderError: Cycles finds no such device.
    """
    scene.view_layers[0].use_pass_object_index = True
    cycles = scene.cycles
    chosen = "cpu" if device == "cpu" else choose_device(device, gpu_counts())
    cycles.device = "CPU" if chosen == "cpu" else "GPU"
    if chosen != "cpu":
        use_gpus(chosen)
    # Samples are few and equal everywhere: an adaptive or denoised pixel costs more here than another sample.
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.use_auto_tile = False
    cycles.use_light_tree = False
    cycles.use_guiding = False
    # The automatic pattern (blue noise) keeps its length from the first render on, so that a picture would depend on
    # earlier renders with another number of samples.
    cycles.sampling_pattern = "TABULATED_SOBOL"
    cycles.pixel_filter_type = "BLACKMAN_HARRIS"
    cycles.filter_width = COLOUR_FILTER_PX
    cycles.max_bounces = 2
    cycles.diffuse_bounces = 1
    cycles.glossy_bounces = 2
    cycles.transmission_bounces = 0
    cycles.volume_bounces = 0
    cycles.transparent_max_bounces = 0
    cycles.caustics_reflective = False
    cycles.caustics_refractive = False
    cycles.sample_clamp_direct = 0.0
    cycles.sample_clamp_indirect = 4.0  # fireflies: one lucky path in a handful would stay as a white dot
    cycles.debug_use_spatial_splits = False


def set_eevee(scene: bpy.types.Scene) -> None:
    """Set EEVEE to shadows, without screen-space effects and baked light.

    EEVEE has no object index pass; every material writes the index to an output variable instead.
    """
    scene.eevee.use_shadows = True  # a new scene starts without
    scene.eevee.use_raytracing = False
    scene.eevee.use_taa_reprojection = False
    variable = scene.view_layers[0].aovs.add()
    variable.name, variable.type = INDEX_AOV, "VALUE"
