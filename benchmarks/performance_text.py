"""The words of docs/performance.md."""

HEADING = """# How fast it is

This page is written by the command below: nothing on it was typed in. The scene is eleven photographs of a
flat (openMVG's `ImageDataset`, CC BY-NC 4.0) with 3,850 sparse points; `--model` is a model of it that
`panolog run` trained. All but the lines about that scene needs no data.

    python -m benchmarks.performance --scene FLAT --model RUN/point_cloud.ply -o docs/performance.md"""

READING = """## How to read it

A **pair** is a pixel and a Gaussian that reaches it. It is **useful** if its alpha is at least 1/255 and
the pixel is not opaque yet: no rasterizer can do with fewer. What a rasterizer evaluates beyond those,
tests and rejects, is its own affair, and so is everything else that it does: the rates divide useful pairs
by the whole pass, projection, sorting and tile lists included.

The **ceiling** is a loop with the arithmetic of a pair and nothing else: all of it stays in registers,
nothing is loaded, sorted or rejected. It runs beside each row on as many threads. No code that computes the
same reaches it.

Times are medians of three after a warm-up, for the trained model means over three training panoramas.
`forward` has projection, spherical harmonics, sorting and compositing; `loss` L1 and SSIM with their
gradient; `backward` goes from the gradient of the image to those of all parameters; `Adam` is the check
that all is finite and the step. The iteration is measured by itself. `peak MB` is all that it holds: model,
moments, target, image and buffers. Numbers of one run belong together; on a shared machine another run may
be a tenth off."""

SECTIONS = {  # title, command, what there is to say
    "rasterizer": (
        "One training iteration",
        "python -m benchmarks.rasterizer --model RUN/point_cloud.ply --scene FLAT --gaussians"
        " 50000,200000,1000000",
        "Random streets as a trained model has them, and the trained model. The photographs have 2,048"
        " pixels; for the widest rows they are enlarged, which no timing can tell. The last table says what"
        " forward and backward are made of, and compositing's own share of the ceiling: blocks of 4×4 pixels"
        " are computed whole, so the share cannot pass useful/evaluated; what projection, order and the way"
        " back through the projection take comes on top.",
    ),
    "opensplat": (
        "Beside OpenSplat",
        "python -m benchmarks.opensplat --scene FLAT",
        "OpenSplat is the one public trainer that runs on CPUs. Its figures are those of release 1.2.0 on"
        " a machine like this one, full training iterations on 256×256 faces of the same scene, with one"
        " core pinned or two; they are constants here, not measured again. A panorama of 1024×512 has as"
        " many pixels for each degree. The first model has one Gaussian for each sparse point; the second"
        " is trained from it for 600 iterations and stops at exactly 50,000. How OpenSplat's pairs per"
        " pixel were counted is not recorded. It looks at every pixel in a box of three standard deviations"
        " and two pixels more; ours in such boxes stand beside our useful ones, and the last column compares"
        " pairs per second on that count.",
    ),
    "growth": (
        "How cost grows",
        "python -m benchmarks.growth",
        "Random streets. With more pixels the same Gaussians cover as many more, so pairs grow with them."
        " With more Gaussians each is smaller, as its neighbours are nearer, and pairs stay until"
        " footprints are as small as a pixel. Lines by least squares, the last through all points. All"
        " cores.",
    ),
    "poles": (
        "At the poles",
        "python -m benchmarks.poles",
        "A street in which one Gaussian in twenty lies within 2° of the zenith or the nadir, against the"
        " same Gaussians turned to the horizon. At the poles they cover many more pixels; that is the"
        " panorama's, and time per useful pair leaves it out. Entries are splats in tiles. All cores.",
    ),
    "memory": (
        "Memory",
        "python -m benchmarks.memory --width 1024,2048,3840",
        "The peak of one forward and one backward pass, gradients of all parameters included, model and"
        " moments not; each in a process of its own. gsplat's figure is a count of the tensors that its"
        " packed mode allocates (`gsplat_bytes` lists them) for the same Gaussians, pixels and entries:"
        " the least it can hold.",
    ),
}
