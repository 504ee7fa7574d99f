//! A planted fault for each kernel: its cases must notice it.

use std::sync::Arc;

use tmpi_core::{Camera, Class, DisparityMap, Geometry, Intrinsics, LayerMasks, Pose, Scene, ViewBox, texture};
use tmpi_pipeline::depth::{DepthKind, from_map, upsample};
use tmpi_pipeline::edges;
use tmpi_pipeline::photo::{Decoded, Limits, decode};
use tmpi_pipeline::planes::{Placement, place, place_again, smooth_labels};
use tmpi_pipeline::{Options, Parallax};
use tmpi_render::{Cpu, RenderError, Renderer, View};

use crate::oracle_depth;

use super::{Checked, Hosts, Kernel, clustering, compositing, error_target, map_filters, matting, photos, quantisation, readers, views};

/// Family, subjects, and the cases run on a faulty kernel.
type Fault = (&'static str, &'static [&'static str], fn(&mut Checked));

/// The faulty renderer goes by the name of that with the widest bounds, and stands for all.
const RENDERERS: [&str; 3] = ["reference", "cpu", "gpu"];

const FAULTS: &[Fault] = &[
    ("clustering", &["linear", "lloyd", "optimal", "slanted"], |c| {
        clustering::clustering(c, |case, method, n| {
            let mut tile = case.place(method, n);
            tile.planes[0].a += 0.01;
            tile
        });
    }),
    // a target twice as wide, and one half as wide
    ("error target", &["linear", "lloyd", "optimal", "slanted"], |c| {
        error_target::targets(c, |map, grid, p| place(map, None, grid, &scaled(p, 2.0)));
    }),
    ("error target", &["linear", "lloyd", "optimal", "slanted"], |c| {
        error_target::targets(c, |map, grid, p| place(map, None, grid, &scaled(p, 0.5)));
    }),
    // as if cameras did not come nearer
    ("parallax", &["pixels of δ"], |c| error_target::pixels(c, |k, v, rect| Parallax::new(k, ViewBox { z: 0.0, ..v }).most(rect))),
    // planes that fit half as well stay
    ("warm start", &["place again"], |c| {
        error_target::warm_start(c, |map, grid, p, tiles| place_again(map, None, grid, &scaled(p, 2.0), tiles, |_| true));
    }),
    // as if noise went unnoticed
    ("denoising", &["local planes"], |c| map_filters::denoise(c, "local planes", DisparityMap::clone)),
    ("denoising", &["median and guided filter"], |c| map_filters::denoise(c, "median and guided filter", DisparityMap::clone)),
    ("snapping", &["snap"], |c| map_filters::snap(c, "snap", edges::clean)),
    ("snapping", &["clean"], |c| map_filters::snap(c, "clean", |photo, map| shifted(edges::clean(photo, map)))),
    ("enlarging", &["guided filter"], |c| map_filters::enlarge(c, |photo, map| shifted(upsample(photo, map)))),
    // the nearest sample everywhere
    ("resizing", &["depth map"], |c| {
        map_filters::resize(c, |file, (w, h)| {
            let map = from_map(file, DepthKind::Disparity, &Limits::default(), 64, 48).ok()?.0;
            Some(DisparityMap::from_fn(w, h, |x, y| map.delta[(y * 48 / h * 64 + x * 64 / w) as usize]))
        });
    }),
    ("label smoothing", &["conditional modes"], |c| {
        map_filters::labels(c, |samples, planes, labels, target, neighbour| {
            smooth_labels(samples, planes, labels, target, 1.5 * neighbour);
        });
    }),
    ("visibility", &["texels"], |c| readers::visibility(c, |geometry| less_hidden(geometry.masks_unpruned()))),
    // creases are softened, as with a camera of so long a focal length
    ("visibility", &["texels"], |c| {
        readers::visibility(c, |geometry| Geometry { intrinsics: Intrinsics::centred(100, 70, 1e4), ..geometry.clone() }.masks_unpruned());
    }),
    // rims are a little too thin
    ("visibility", &["texels"], |c| readers::visibility(c, |geometry| thinner_rims(geometry.masks_unpruned()))),
    // texels of a smaller view box
    ("pruning", &["texels"], |c| {
        readers::pruning(c, |geometry| Geometry { view_box: ViewBox { x: 0.07, ..geometry.view_box }, ..geometry.clone() }.masks());
    }),
    ("inpainting", &["pyramid"], |c| {
        readers::inpainting(c, |photo, geometry| {
            let mut layers = texture(photo, geometry, geometry.masks());
            layers.iter_mut().flatten().filter_map(|l| l.hidden.first_mut()).for_each(|p| *p = [251; 3]);
            layers
        });
    }),
    // a share that is a little too large
    ("matting", &["mattes"], |c| {
        matting::cases(c, |photo, geometry| {
            let mut layers = texture(photo, geometry, geometry.masks());
            let alphas = layers.iter_mut().flatten().flat_map(|l| &mut l.shape.alpha);
            alphas.filter(|a| (1..200).contains(*a)).for_each(|a| *a += 30);
            layers
        });
    }),
    // half a degree of turn
    ("planes", &["gpu"], |c| {
        views::run(
            c,
            &hosts(|cpu, scene, camera| cpu.render(scene, &Camera { pose: Pose { yaw: camera.pose.yaw + 0.5, ..camera.pose }, ..*camera })),
        );
    }),
    // a surface is lost where it comes near
    ("near", &["gpu"], |c| {
        let lost = hosts(|cpu, scene, camera| {
            let mut view = cpu.render(scene, camera)?;
            view.rgba.iter_mut().filter(|_| camera.pose.tz > 0.9985).for_each(|p| *p = [0; 4]);
            Ok(view)
        });
        views::near(c, lost.all[0].as_ref());
    }),
    // what cannot be drawn is a black picture
    ("cameras", &["gpu"], |c| {
        let drawn = hosts(|cpu, scene, camera| {
            Ok(cpu.render(scene, camera).unwrap_or(View { width: camera.width, height: camera.height, rgba: vec![[0; 4]; 640] }))
        });
        views::refusals(c, drawn.all[0].as_ref());
    }),
    // of equals the first lies in front
    ("compositing", &["gpu"], |c| {
        let first = hosts(|cpu, scene, camera| {
            let mut scene = Scene::clone(scene);
            scene.layers.reverse();
            cpu.render(&Arc::new(scene), camera)
        });
        compositing::ties(c, first.all[0].as_ref(), 1.51);
    }),
    ("photos", &["decoder"], |c| {
        photos::decoder(c, |file| {
            let decoded = decode(file, &Limits::default(), None)?;
            Ok(Decoded { intrinsics: Intrinsics { fx: decoded.intrinsics.fx * 1.01, ..decoded.intrinsics }, ..decoded })
        });
    }),
    ("photos", &["gpu"], |c| {
        photos::run(
            c,
            &hosts(|cpu, scene, camera| {
                let mut view = cpu.render(scene, camera)?;
                view.rgba.reverse();
                Ok(view)
            }),
        );
    }),
    // coefficients between the grid's
    ("quantisation", &["planes"], |c| quantisation::rounding(c, |plane| *plane)),
    ("quantisation", &["depth map"], |c| {
        let eight_bits = |d: &f32| (d * 255.0).round() / 255.0;
        quantisation::sixteen_bits(c, |map| Some(DisparityMap { delta: map.delta.iter().map(eight_bits).collect(), ..*map }));
    }),
    // the nearest layer of all is lost
    ("quantisation", &["container"], |c| {
        let models = oracle_depth::models(photos::Brightness);
        let hole = |file: &[u8], options: &Options| {
            let mut scene = Scene::clone(&*photos::made(&models, file, options)?);
            scene.layers.pop();
            Some(Arc::new(scene))
        };
        quantisation::options(c, hole, &Hosts { all: Vec::new() });
    }),
];

/// Whether a fault is planted for a kernel.
pub(super) fn covers(kernel: &Kernel) -> bool {
    FAULTS.iter().any(|f| f.0 == kernel.family && (f.1.contains(&kernel.subject) || RENDERERS.contains(&kernel.subject)))
}

#[test]
fn a_fault_of_each_kernel_is_caught() {
    for (family, subjects, cases) in FAULTS {
        let mut checked = Checked::default();
        cases(&mut checked);
        let kernels = checked.kernels();
        let caught = |subject: &&str| kernels.iter().any(|k| (k.family, k.subject) == (*family, *subject) && k.failed > 0);
        assert!(subjects.iter().all(caught), "{family}: {kernels:?}");
    }
}

fn shifted(mut map: DisparityMap) -> DisparityMap {
    map.delta[0] += 0.02;
    map
}

/// Masks of which one hidden texel is empty.
fn less_hidden(mut masks: Vec<LayerMasks>) -> Vec<LayerMasks> {
    let classes = masks.iter_mut().flat_map(|m| &mut m.layers).flat_map(|l| &mut l.class);
    classes.filter(|c| **c == Class::Hidden as u8).take(1).for_each(|c| *c = Class::Empty as u8);
    masks
}

/// Masks whose soft texels have an alpha one lower.
fn thinner_rims(mut masks: Vec<LayerMasks>) -> Vec<LayerMasks> {
    let alphas = masks.iter_mut().flat_map(|m| &mut m.layers).flat_map(|l| &mut l.alpha);
    alphas.filter(|a| (2..u8::MAX).contains(*a)).for_each(|a| *a -= 1);
    masks
}

fn scaled(placement: &Placement, by: f64) -> Placement {
    Placement { target: placement.target.map(|t| t * by), ..*placement }
}

/// A renderer that draws something else.
struct Faulty(Cpu, Drawn);

type Drawn = fn(&Cpu, &Arc<Scene>, &Camera) -> Result<View, RenderError>;

fn hosts(fault: Drawn) -> Hosts {
    Hosts { all: vec![Arc::new(Faulty(Cpu::default(), fault))] }
}

impl Renderer for Faulty {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn render(&self, scene: &Arc<Scene>, camera: &Camera) -> Result<View, RenderError> {
        (self.1)(&self.0, scene, camera)
    }
}
