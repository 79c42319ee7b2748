"""Rasterizer, losses and optimiser of the mapper for NVIDIA GPUs: CUDA C++, compiled at run time by NVRTC.

Nothing here is imported unless a GPU engine or renderer is asked for; then torch with CUDA and NVRTC (a part
of torch's own wheels) are needed, and no compiler.

    source      text of the kernels, with the constants of `layout.py` and the argument structures
    rtc         NVRTC: from the text to machine code, with a cache on disk
    driver      loads machine code and launches kernels on torch's stream
    gaussians   the Gaussians with their optimiser state in device memory
    buffers     working memory of the passes
    view        forward and backward pass at one image size
    targets     a keyframe's images, depths and beams as one block of bytes; target_cache: these on the device
    keyframe_states   corrections of pose and exposure in device memory
    training    a step of the mapper: forward, losses, backward, Adam, as one CUDA graph
    device_map  all of them together: what an engine on a GPU needs

No kernel uses atomics: the same input gives the same bits on the same GPU model and NVRTC version. The same
source runs on a CPU in the tests, compiled by g++ with a header that emulates blocks, barriers and shuffles.
"""
