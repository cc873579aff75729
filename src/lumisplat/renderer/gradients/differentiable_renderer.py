"""Gradients of a loss with respect to the inputs of an unlit frame, or to the Gaussians that unlit rays hit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import Projection, RasterStrategy, RenderConfig, TraceStrategy
from lumisplat.device.structs.camera import ListedRays
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.errors import ConfigError
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.progress import Progress
from lumisplat.renderer.checks import checked_config
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.gradients.arrays import (
    RayGradients,
    SplatGradients,
    by_background,
    given_array,
    host_values,
    set_gradient,
)
from lumisplat.renderer.gradients.features import FeatureChannels, RenderedFeatures
from lumisplat.renderer.gradients.pose import PoseSums, pose_gradient
from lumisplat.renderer.gradients.ray_backward import RayBackward, TracedFrame, UpstreamGradient, check_traced
from lumisplat.renderer.gradients.splat_backward import SplatBackward
from lumisplat.renderer.gradients.unscented_backward import UnscentedBackward, UnscentedFrame
from lumisplat.renderer.raster.unlit_raster import DrawnSplats
from lumisplat.renderer.rays import checked_rays, tracing
from lumisplat.renderer.renderer import Renderer
from lumisplat.renderer.scene.camera_table import check_camera, refuse_window
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene


class DifferentiableRenderer(Renderer):
    """Renders unlit frames with sorted blending, and computes gradients of a loss through them. Not thread-safe.

    ``render`` draws the same frame, to the bit, as `lumisplat.Renderer` with ``lighting=False``: lights and materials
    of the scene are ignored. ``gradients`` then traverses the Gaussians of each pixel of the last frame once more,
    front to back (docs/method/gradients.md). The backward pass uses no atomics: its results have the same bits for any
    number of threads.

    With ``Pipeline.TRACE``, frames have one ray a pixel; cameras may have a fisheye, a distorted lens or a rolling
    shutter, and Gaussian kernels any degree. ``Projection.UNSCENTED`` needs kernels of degree 2. ``Pipeline.TRACE`` and
    ``Projection.UNSCENTED`` do not support ``render_features``.

    Args:
        config: Settings; None: the defaults. Its pipeline is ``RASTER`` or ``TRACE``.
        device: As for `lumisplat.create_renderer`.
        threads: As for `lumisplat.create_renderer`.
        progress: As for `lumisplat.create_renderer`.

    Raises:
        ConfigError: The config asks for another pipeline or strategy, for more samples, or for lights.
        DeviceError: The device does not exist.
    """

    def __init__(
        self,
        config: RenderConfig | None = None,
        device: str = "auto",
        *,
        threads: int | None = None,
        progress: Progress | None = None,
    ) -> None:
        super().__init__(_checked(checked_config(config)), Launcher(device, threads), progress, compiles=False)
        self._prepare()

    def reconfigure(self, config: RenderConfig) -> None:
        """Changes the settings, like `lumisplat.Renderer.reconfigure`; call `render` again before `gradients`.

        Raises:
            ConfigError: As for `DifferentiableRenderer`; the renderer is unchanged.
        """
        super().reconfigure(_checked(checked_config(config)))
        self._prepare()

    def _prepare(self) -> None:
        """Creates the backward passes for the current settings, and forgets the last frame."""
        self._traces = not self.config.pipeline.rasterises
        self._is_unscented = not self._traces and self.config.raster.projection is Projection.UNSCENTED
        self._splat_backward = SplatBackward(self._launcher, self._buffers)
        self._ray_backward = RayBackward(self._launcher, self._buffers, self.config)
        self._unscented_backward = UnscentedBackward(self._launcher, self._buffers)
        self._features = FeatureChannels(self._launcher, self._buffers, self._unlit_raster, self._splat_backward)
        self._load(self._modules(FramePlan.of(self.config, Scene())))
        self._last_drawn: tuple[Scene, Camera, DrawnSplats] | None = None
        self._rendered_features: RenderedFeatures | None = None
        self._traced_frame: TracedFrame | None = None
        self._unscented_frame: UnscentedFrame | None = None

    def _modules(self, plan: FramePlan, **options: bool) -> list[KernelModule]:
        """Returns the kernel modules of a frame and of its backward pass."""
        backward = (
            self._ray_backward
            if self._traces
            else self._unscented_backward
            if self._is_unscented
            else self._splat_backward
        )
        return [*backward.modules(), *super()._modules(plan, **options)]

    def render(self, scene: Scene, camera: Camera, **options: Any) -> Frame:
        """Renders a frame like `lumisplat.Renderer.render`, and stores what `gradients` needs.

        Raises:
            ConfigError: The camera has a distorted lens, but frames are rasterised without ``Projection.UNSCENTED``:
                such frames are resampled and have no gradients. Or rays are traced and a mesh reflects, refracts or
                blends.
        """
        self._forget()
        check_camera(camera)
        refuse_window(camera, "gradients")
        along_rays = self._traces or self._is_unscented
        if along_rays and options.get("resume") is not None:
            raise ConfigError("a resumed frame has more than one sample per pixel and no gradients: omit resume")
        if self._traces:
            check_traced(scene)
            frame = super().render(scene, camera, **options)
            self._traced_frame = TracedFrame(scene, camera, self._hits)
            return frame
        if self._is_unscented:
            check_traced(scene)
            frame = super().render(scene, camera, **options)
            if self._unscented.drawn is not None:
                self._unscented_frame = UnscentedFrame(scene, camera, self._unscented.drawn)
            return frame
        if camera.is_distorted:
            raise ConfigError(
                "frames of a distorted lens are resampled and have no gradients: use a pinhole camera, or "
                "RenderConfig(raster=RasterConfig(projection=Projection.UNSCENTED))"
            )
        frame = super().render(scene, camera, **options)
        if self._unlit_raster.drawn is not None:
            self._last_drawn = scene, camera, self._unlit_raster.drawn
        return frame

    def render_features(self, features: npt.ArrayLike) -> FloatArray:
        """Blends arbitrary features of Gaussians over the pixels of the last frame, weighted as the colours are.

        The results are weighted sums. To get means, divide the results by the sum of weights. In a scene without
        meshes, this sum is ``frame.alpha``; with meshes, it is the result for a feature that is 1 for all Gaussians.
        Meshes and background contribute nothing. ``gradients`` accepts gradients with respect to the result.

        Args:
            features: C numbers of any sign for each of the scene's N Gaussians, instance by instance, shape (N, C). For
                view depths and normals see ``lumisplat.gradients.SurfaceFeatures``.

        Returns:
            Weighted sums of the C features at each pixel, float32, shape (H, W, C).

        Raises:
            ConfigError: No frame was rendered yet, or the settings are ``Pipeline.TRACE`` or ``Projection.UNSCENTED``.
            SceneError: The shape is not (N, C), or a value is not finite.
        """
        if self._traces or self._is_unscented:
            mode = "Pipeline.TRACE" if self._traces else "Projection.UNSCENTED"
            raise ConfigError(f"render_features: needs Pipeline.RASTER without Projection.UNSCENTED, not {mode}")
        _, camera, drawn = self._last_frame("render_features")
        columns = np.shape(features)[1] if np.ndim(features) == 2 else 1
        values = given_array("features", features, (drawn.splats.count, max(columns, 1)))
        self._load(self._features.modules())
        self._rendered_features = self._features.render(self._scene, drawn, values)
        return host_values(self._rendered_features.of_pixels).reshape(camera.height, camera.width, -1)

    def gradients(
        self,
        dL_dcolor: npt.ArrayLike,
        dL_dalpha: npt.ArrayLike | None = None,
        *,
        dL_dfeatures: npt.ArrayLike | None = None,
        pose: bool = False,
    ) -> SplatGradients:
        """Computes the gradients of a loss with respect to the inputs of the last frame.

        Args:
            dL_dcolor: Gradient of the loss with respect to ``frame.color`` over ``config.background``, display-referred
                sRGB, shape (H, W, 3). Arrays of other packages are read by ``__array_interface__``, ``__array__`` or
                DLPack.
            dL_dalpha: Gradient of the loss with respect to ``frame.alpha``, shape (H, W); None: 0.
            dL_dfeatures: Gradient of the loss with respect to the last result of ``render_features``, shape (H, W, C)
                for C features; None: 0. The features count as constants that are blended, so their gradient contributes
                to all results. If the features depend on Gaussians or on the camera, continue the chain rule from
                ``SplatGradients.features``.
            pose: Whether to differentiate with respect to the camera pose, too.

        Raises:
            ConfigError: No frame was rendered yet, or ``dL_dfeatures`` is given but no features of this frame were
                rendered.
            SceneError: A shape does not fit, a value is not finite, or the scene is lit.
        """
        if (self._traces or self._is_unscented) and dL_dfeatures is not None:
            mode = "Pipeline.TRACE" if self._traces else "Projection.UNSCENTED"
            raise ConfigError(f"gradients: dL_dfeatures needs Pipeline.RASTER without UNSCENTED, not {mode}")
        if self._unscented_frame is not None:
            camera = self._unscented_frame.camera
            by_color, gradient = self._given((camera.height, camera.width), dL_dcolor, dL_dalpha)
            return self._unscented_backward.of_frame(self._scene, self._unscented_frame, by_color, gradient, pose=pose)
        if self._traced_frame is not None:
            by_color, gradient = self._given(self._traced_frame.shape, dL_dcolor, dL_dalpha)
            return self._ray_backward.of_frame(self._scene, self._traced_frame, by_color, gradient, pose=pose)
        scene, camera, drawn = self._last_frame("gradients")
        shape = (camera.height, camera.width)
        by_color, gradient = self._given(shape, dL_dcolor, dL_dalpha)
        pixels = PixelBuffers.of(self._buffers, self._scene.image_size).data
        by_splat = self._splat_backward.splats(self._scene, drawn, pixels, gradient)
        features = None if dL_dfeatures is None else self._by_features(drawn, dL_dfeatures, shape, by_splat)
        sets = [
            set_gradient(self._splat_backward.gaussians(self._scene, drawn, by_splat, number))
            for number in range(len(self._scene.assets))
        ]
        splats = _visible(by_splat.numpy(), drawn)
        transmittance = np.where(host_values(drawn.meshes.depth_z) < np.inf, 0.0, 1.0 - host_values(pixels.alpha))
        return SplatGradients(
            sets=tuple(sets),
            background=by_background(by_color, transmittance),
            camera_from_world=self._by_pose(scene, camera, drawn, by_splat) if pose else None,
            centers=splats["center"],
            centers_absolute=splats["center_absolute"],
            weights=splats["weight"],
            features=features,
        )

    def ray_gradients(
        self,
        scene: Scene,
        origins: npt.ArrayLike,
        directions: npt.ArrayLike,
        dL_dradiance: npt.ArrayLike,
        dL_dtransmittance: npt.ArrayLike | None = None,
    ) -> RayGradients:
        """Computes gradients at rays like `lumisplat.gradients.ray_gradients`, but reuses BVHs of earlier calls.

        The renderer's pipeline must be ``TRACE``. Arguments, result and errors are as for the function.
        """
        if not self._traces:
            raise ConfigError("ray_gradients: needs a renderer with Pipeline.TRACE; this one rasterises")
        start, along = checked_rays(origins, directions)
        given = UpstreamGradient.of(len(start), dL_dradiance, dL_dtransmittance)
        check_traced(scene)
        hits = self.trace_rays(scene, start, along)
        return self._ray_backward.of_rays(self._scene, self._tracer, (self._local(start), along), hits, given)

    def _find_hits(self, plan: FramePlan, listed: ListedRays | None) -> PrimaryHits:
        """Finds the hits of the frame's only sample, and stores them for the backward pass."""
        self._hits = super()._find_hits(plan, listed)
        return self._hits

    def _plan_of(self, scene: Scene, camera: Camera | None = None) -> FramePlan:
        """Returns the plan of a frame.

        Its rays traverse BVHs, because its gradients are found by the same BVHs. All splats are sorted by their means,
        because the backward pass walks them in this order.
        """
        return replace(FramePlan.of(self.config, scene), merges_sets=False)

    def _sync_rays(self, scene: Scene, camera: Camera | None = None) -> FramePlan:
        """Syncs the scene for a caller's rays. The last frame is dropped: it has no gradients any more."""
        self._forget()
        return super()._sync_rays(scene, camera)

    def _forget(self) -> None:
        self._last_drawn = self._rendered_features = self._traced_frame = self._unscented_frame = None

    def _given(
        self, shape: tuple[int, int], dL_dcolor: npt.ArrayLike, dL_dalpha: npt.ArrayLike | None
    ) -> tuple[FloatArray, PixelGradient]:
        """Checks a caller's gradients at pixels; returns the gradients of colours, and all gradients on the device."""
        by_color = given_array("dL_dcolor", dL_dcolor, (*shape, 3))
        by_alpha = np.zeros(shape, np.float32) if dL_dalpha is None else given_array("dL_dalpha", dL_dalpha, shape)
        gradient = PixelGradient()
        gradient.color = self._buffers.upload("gradient.color", wp.vec3, by_color.reshape(-1, 3))
        gradient.alpha = self._buffers.upload("gradient.alpha", wp.float32, by_alpha.reshape(-1))
        return by_color, gradient

    def _last_frame(self, caller: str) -> tuple[Scene, Camera, DrawnSplats]:
        """Returns the scene, the camera and the splats of the last rasterised frame.

        Raises:
            ConfigError: No frame was rendered yet.
        """
        if self._last_drawn is None:
            raise ConfigError(f"{caller}: render a frame first")
        return self._last_drawn

    def _by_features(
        self, drawn: DrawnSplats, dL_dfeatures: npt.ArrayLike, shape: tuple[int, int], by_splat: DeviceArray
    ) -> FloatArray:
        """Returns gradients with respect to features; adds their effect on splat shape gradients to ``by_splat``."""
        if self._rendered_features is None:
            raise ConfigError("gradients: call render_features for this frame before passing dL_dfeatures")
        count = self._rendered_features.count
        by_pixels = given_array("dL_dfeatures", dL_dfeatures, (*shape, count)).reshape(-1, count)
        return host_values(self._features.backward(self._scene, drawn, self._rendered_features, by_pixels, by_splat))

    def _by_pose(self, scene: Scene, camera: Camera, drawn: DrawnSplats, by_splat: DeviceArray) -> Doubles:
        total = np.zeros((4, 4))
        for number, instance in enumerate(scene.splats):
            sums = PoseSums.of(self._splat_backward.pose(self._scene, drawn, by_splat, number))
            total[:3] += pose_gradient(sums, instance, camera)
        return total


def splat_gradients(
    scene: Scene,
    camera: Camera,
    dL_dcolor: npt.ArrayLike,
    dL_dalpha: npt.ArrayLike | None = None,
    config: RenderConfig | None = None,
    *,
    pose: bool = False,
    device: str = "auto",
) -> SplatGradients:
    """Computes gradients of a loss with respect to the Gaussians of a scene, from the loss's gradients at a frame.

    For more than one frame, reuse a `lumisplat.DifferentiableRenderer`::

        frame = ls.render(scene, camera)
        gradients = ls.splat_gradients(scene, camera, 2.0 * (frame.color - image))
        gradients.sets[0].means  # of the first Gaussian set, shape (N, 3)

    The frame is unlit. A Gaussian is cut off where its alpha falls below 1/255. As in gsplat, the gradients ignore that
    this edge moves with opacities and scales. Finite differences include the movement; it makes up some percent of the
    derivative.

    Args:
        scene: The scene.
        camera: The camera.
        dL_dcolor: As for `lumisplat.DifferentiableRenderer.gradients`.
        dL_dalpha: As for `lumisplat.DifferentiableRenderer.gradients`.
        config: Settings; None: the defaults.
        pose: Whether to differentiate with respect to the camera pose, too.
        device: As for `lumisplat.create_renderer`.

    Raises:
        ConfigError: The config asks for another pipeline or strategy, or for lights.
        DeviceError: The device does not exist or is out of memory.
        SceneError: As for `lumisplat.Renderer.render`; or an array's shape does not fit, or a value is not finite.
    """
    renderer = DifferentiableRenderer(config, device)
    renderer.render(scene, camera)
    return renderer.gradients(dL_dcolor, dL_dalpha, pose=pose)


def ray_gradients(
    scene: Scene,
    origins: npt.ArrayLike,
    directions: npt.ArrayLike,
    dL_dradiance: npt.ArrayLike,
    dL_dtransmittance: npt.ArrayLike | None = None,
    *,
    config: RenderConfig | None = None,
    device: str = "auto",
) -> RayGradients:
    """Computes gradients of a loss with respect to the Gaussians of a scene, from the loss's gradients at rays.

    The rays are unlit, and equal those that `lumisplat.trace_rays` traces. For more than one call, reuse a
    `lumisplat.DifferentiableRenderer`::

        hits = ls.trace_rays(scene, origins, directions, ls.RenderConfig(lighting=False))
        gradients = ls.gradients.ray_gradients(scene, origins, directions, 2.0 * (hits.radiance - colors))

    Args:
        scene: The scene.
        origins: World-space origin of each of N rays, shape (N, 3), or one origin for all rays, shape (3,).
        directions: World-space direction of each ray, of any length, shape (N, 3).
        dL_dradiance: Gradient of the loss with respect to ``RayHits.radiance``, display-referred sRGB, shape (N, 3);
            arrays as for `lumisplat.DifferentiableRenderer.gradients`.
        dL_dtransmittance: Gradient of the loss with respect to ``RayHits.transmittance``, shape (N,); None: 0.
        config: Settings; None: the defaults. The pipeline is always ``TRACE``.
        device: As for `lumisplat.create_renderer`.

    Raises:
        ConfigError: The config asks for another strategy, more samples or lights; or a mesh reflects, refracts or
            blends.
        DeviceError: The device does not exist or is out of memory.
        SceneError: As for `lumisplat.trace_rays`; or an array's shape does not fit, or a value is not finite.
    """
    renderer = DifferentiableRenderer(tracing(config), device)
    return renderer.ray_gradients(scene, origins, directions, dL_dradiance, dL_dtransmittance)


def _checked(config: RenderConfig) -> RenderConfig:
    """Returns the settings with lighting switched off.

    Raises:
        ConfigError: Frames rendered with the settings have no gradients.
    """
    if not config.pipeline.is_differentiable:
        raise ConfigError(f"gradients need Pipeline.RASTER or Pipeline.TRACE, not Pipeline.{config.pipeline.name}")
    traces = not config.pipeline.rasterises
    strategy = config.trace.strategy if traces else config.raster.strategy
    if strategy not in (TraceStrategy.SORTED, RasterStrategy.SORTED):
        raise ConfigError(f"gradients need the strategy SORTED, not {strategy.name}")
    along_rays = traces or config.raster.projection is Projection.UNSCENTED
    if along_rays and (config.samples not in (None, 1) or config.time_limit is not None or config.noise is not None):
        raise ConfigError("gradients along rays need one sample per pixel: do not set samples, time_limit or noise")
    if config.lighting or config.aovs:
        raise ConfigError("gradients need unlit frames without AOVs: do not set lighting or aovs")
    return replace(config, lighting=False)


def _visible(splats: npt.NDArray[np.void], drawn: DrawnSplats) -> npt.NDArray[np.void]:
    """Returns the splat gradients. Splats that cover no tile have undefined gradients; these are replaced by 0."""
    rects = drawn.splats.rects.numpy()
    splats = splats.copy()
    splats[rects["x0"] >= rects["x1"]] = np.zeros(1, splats.dtype)
    return splats
