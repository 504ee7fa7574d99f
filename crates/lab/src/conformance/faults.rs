//! A planted fault for each kernel: its cases must notice it.

use std::sync::Arc;

use tmpi_core::container::{self, RegionPhoto, TileRect};
use tmpi_core::{Camera, Class, DisparityMap, Geometry, Intrinsics, LayerMasks, Plane, Pose, Scene, ViewBox, texture};
use tmpi_live::align::{Affine, fit};
use tmpi_pipeline::depth::{DepthKind, from_map, upsample};
use tmpi_pipeline::photo::{Decoded, Limits, decode};
use tmpi_pipeline::planes::{Placement, place, place_again, smooth_labels};
use tmpi_pipeline::{Options, Parallax, edges};
use tmpi_render::{Cpu, RenderError, Renderer, View};

use super::{
    Checked, Host, Kernel, Verdict, clustering, colours, compositing, error_target, levels, live_depth, live_motion, map_filters, matting,
    photos, quantisation, readers, stereo, view_box_corners, views,
};

struct Fault {
    family: &'static str,
    subjects: &'static [&'static str],
    /// Starts of the names of the cases that are meant for it; empty: all of the kernel. One of each must notice it, by each subject.
    cases: &'static [&'static str],
    /// Runs the cases of the faulty kernel.
    run: fn(&mut Checked),
}

/// The faulty renderer goes by the name of that with the widest bounds, and stands for all.
const RENDERERS: [&str; 3] = ["reference", "cpu", "gpu"];

const fn fault(family: &'static str, subjects: &'static [&'static str], cases: &'static [&'static str], run: fn(&mut Checked)) -> Fault {
    Fault { family, subjects, cases, run }
}

const FAULTS: &[Fault] = &[
    fault("clustering", &["linear", "lloyd", "optimal", "slanted"], &["constant", "steep ramp", "1×1", "3 distinct values"], |c| {
        clustering::clustering(c, |case, method, n| {
            let mut tile = case.place(method, n);
            tile.planes[0].a += 0.01;
            tile
        });
    }),
    // a target twice as wide, and one half as wide
    fault("error target", &["linear", "lloyd", "optimal", "slanted"], &[""], |c| {
        error_target::targets(c, |map, grid, p| place(map, None, grid, &scaled(p, 2.0)));
    }),
    fault("error target", &["linear", "lloyd", "optimal", "slanted"], &[""], |c| {
        error_target::targets(c, |map, grid, p| place(map, None, grid, &scaled(p, 0.5)));
    }),
    // as if cameras did not come nearer
    fault("parallax", &["pixels of δ"], &["all, centred, forward", "a tile, centred, nearly up to a surface"], |c| {
        error_target::pixels(c, |k, v, rect| Parallax::new(k, ViewBox { z: 0.0, ..v }).most(rect));
    }),
    // planes that fit half as well stay
    fault("warm start", &["place again"], &[""], |c| {
        error_target::warm_start(c, |map, grid, p, tiles| place_again(map, None, grid, &scaled(p, 2.0), tiles, |_| true));
    }),
    // as if noise went unnoticed
    fault("denoising", &["local planes"], &["holes of one pixel", "noise on one value", "noise on a slope", "noise on a step"], |c| {
        map_filters::denoise(c, "local planes", DisparityMap::clone);
    }),
    fault("denoising", &["median and guided filter"], &["holes of one pixel", "noise on one value", "noise on a slope"], |c| {
        map_filters::denoise(c, "median and guided filter", DisparityMap::clone);
    }),
    fault("snapping", &["snap"], &["a step blurred over 5 pixels"], |c| {
        map_filters::snap(c, "snap", edges::median);
    }),
    fault("snapping", &["median"], &["one value, unchanged", "one row, unchanged"], |c| {
        map_filters::snap(c, "median", |photo, map| shifted(edges::median(photo, map)));
    }),
    fault("snapping", &["widen"], &["a thing 3 pixels too small"], |c| {
        map_filters::snap(c, "widen", edges::median);
    }),
    fault("enlarging", &["guided filter"], &["noise by noise", "one pixel", "one value to 16 times the size"], |c| {
        map_filters::enlarge(c, |photo, map| shifted(upsample(photo, map)));
    }),
    // the nearest sample everywhere
    fault("resizing", &["depth map"], &["a slope, to 128 × 96", "one row, "], |c| {
        map_filters::resize(c, |file, (w, h)| {
            let map = from_map(file, DepthKind::Disparity, &Limits::default(), 64, 48).ok()?.0;
            Some(DisparityMap::from_fn(w, h, |x, y| map.delta[(y * 48 / h * 64 + x * 64 / w) as usize]))
        });
    }),
    fault("label smoothing", &["conditional modes"], &["noise"], |c| {
        map_filters::labels(c, |samples, planes, labels, target, neighbour| {
            smooth_labels(samples, planes, labels, target, 1.5 * neighbour);
        });
    }),
    // whole pixels only
    fault("stereo", &["matching"], &["parts of a pixel"], |c| {
        stereo::pairs(c, |first, second| Some(stereo::measured(first, second)?.into_iter().map(f64::round).collect()));
    }),
    fault("live depth", &["scale and shift"], &["60×60, scale 0.5", "400×300, scale 1.6"], |c| {
        live_depth::scales(c, |new, last, steady| Affine { scale: 1.0, ..fit(new, last, steady) });
    }),
    fault("live depth", &["borders"], &["80×80, stale", "77×61, stale"], |c| live_depth::borders(c, |_, _, _, _| {})),
    // against the motion
    fault("live motion", &["labels"], &["5 right, 0 down", "-4 right, 3 down"], |c| {
        live_motion::labels(c, |geometry, was, now| live_motion::followed(geometry, now, was));
    }),
    // four levels too red
    fault("high dynamic range", &["tone mapping"], &["any colours", "one pixel of reference white"], |c| {
        colours::high_dynamic_range(c, |file| {
            let mut photo = decode(file, &Limits::default(), None).ok()?.photo;
            photo.rgb.iter_mut().for_each(|p| p[0] = p[0].saturating_add(4));
            Some(photo)
        });
    }),
    // eyes swapped
    fault("anaglyphs", &["mix"], &["any colours, ", "white and black, "], |c| {
        colours::anaglyphs(c, |left, right, layout| colours::mixed(right, left, layout));
    }),
    fault("visibility", &["texels"], &["a square before a wall", "one row", "a panorama"], |c| {
        readers::visibility(c, |geometry| less_hidden(geometry.masks_unpruned()));
    }),
    // creases are softened, as with a camera of so long a focal length
    fault("visibility", &["texels"], &["a crease"], |c| {
        readers::visibility(c, |geometry| Geometry { intrinsics: Intrinsics::centred(100, 70, 1e4), ..geometry.clone() }.masks_unpruned());
    }),
    // rims are a little too thin
    fault("visibility", &["texels"], &["a square before a wall"], |c| {
        readers::visibility(c, |geometry| thinner_rims(geometry.masks_unpruned()));
    }),
    // texels of a smaller view box
    fault("pruning", &["texels"], &["a square before a wall, δ 0 behind 1: seen and left out"], |c| {
        readers::pruning(c, |geometry| Geometry { view_box: ViewBox { x: 0.07, ..geometry.view_box }, ..geometry.clone() }.masks());
    }),
    fault("inpainting", &["pyramid"], &["one colour behind white", "a slope behind white"], |c| {
        readers::inpainting(c, |photo, geometry| {
            let mut layers = texture(photo, geometry, geometry.masks());
            layers.iter_mut().flatten().filter_map(|l| l.hidden.first_mut()).for_each(|p| *p = [251; 3]);
            layers
        });
    }),
    // a photo with loss
    fault("levels and regions", &["containers"], &["colours, noise", "colours, one row", "colours, a panorama"], |c| {
        levels::regions(c, |file, tiles, level| container::region(file, tiles, level, RegionPhoto::Jpeg));
    }),
    // the tiles one further to the left
    fault("levels and regions", &["containers"], &["depth, noise", "depth, one row", "camera, noise", "camera, a panorama"], |c| {
        levels::regions(c, |file, tiles, level| {
            let columns = tiles.columns.start.saturating_sub(1)..tiles.columns.end - 1;
            container::region(file, &TileRect { columns, ..tiles.clone() }, level, RegionPhoto::Lossless)
        });
    }),
    // a share that is a little too large
    fault("matting", &["mattes"], &["shares, black before white"], |c| {
        matting::cases(c, |photo, geometry| {
            let mut layers = texture(photo, geometry, geometry.masks());
            let alphas = layers.iter_mut().flatten().flat_map(|l| &mut l.shape.alpha);
            alphas.filter(|a| (1..200).contains(*a)).for_each(|a| *a += 30);
            layers
        });
    }),
    // half a degree of turn
    fault("planes", &["gpu"], &["ground", "typical", "holes", "one row"], |c| {
        let turned =
            hosts(|cpu, scene, camera| cpu.render(scene, &Camera { pose: Pose { yaw: camera.pose.yaw + 0.5, ..camera.pose }, ..*camera }));
        views::run(c, &turned);
    }),
    // a surface is lost where it comes near
    fault("near", &["gpu"], &["two values, 0.9990 of the way", "two values, 0.9995 of the way"], |c| {
        let lost = hosts(|cpu, scene, camera| {
            let mut view = cpu.render(scene, camera)?;
            view.rgba.iter_mut().filter(|_| camera.pose.tz > 0.9985).for_each(|p| *p = [0; 4]);
            Ok(view)
        });
        views::near(c, lost[0].as_ref());
    }),
    // what cannot be drawn is a black picture
    fault("cameras", &["gpu"], &["pose of NaN", "focal length 0", "width 0", "8192×8193"], |c| {
        let drawn = hosts(|cpu, scene, camera| {
            Ok(cpu.render(scene, camera).unwrap_or(View { width: camera.width, height: camera.height, rgba: vec![[0; 4]; 640] }))
        });
        views::refusals(c, drawn[0].as_ref());
    }),
    // of equals the first lies in front
    fault("compositing", &["gpu"], &["ties in depth, soft"], |c| {
        let first = hosts(|cpu, scene, camera| {
            let mut scene = Scene::clone(scene);
            scene.layers.reverse();
            cpu.render(&Arc::new(scene), camera)
        });
        compositing::ties(c, first[0].as_ref(), 1.51);
    }),
    // what covers the photo is missing along its left border, and all is darker
    fault(
        "compositing",
        &["gpu"],
        &["64 layers of alpha 128/255", "identity view of flat", "borders of flat", "borders of typical"],
        |c| {
            let dark = hosts(|cpu, scene, camera| {
                let mut view = cpu.render(scene, camera)?;
                let width = view.width as usize;
                view.rgba.iter_mut().for_each(|p| *p = p.map(|v| v.saturating_sub(4)));
                view.rgba.iter_mut().step_by(width).for_each(|p| *p = [0; 4]);
                Ok(view)
            });
            compositing::run(c, &dark);
        },
    ),
    // rows from the bottom up
    fault("photos", &["decoder"], &["63×63, decoded", "16 bits, decoded", "greyscale JPEG, decoded", "alpha, decoded"], |c| {
        photos::decoder(c, |file| {
            let mut decoded = decode(file, &Limits::default(), None)?;
            let width = decoded.photo.width as usize;
            decoded.photo.rgb = decoded.photo.rgb.rchunks(width).flatten().copied().collect();
            Ok(decoded)
        });
    }),
    fault("photos", &["decoder"], &["EXIF focal length of 27 mm", "EXIF focal length of 0 mm"], |c| {
        photos::decoder(c, |file| {
            let decoded = decode(file, &Limits::default(), None)?;
            Ok(Decoded { intrinsics: Intrinsics { fx: decoded.intrinsics.fx * 1.01, ..decoded.intrinsics }, ..decoded })
        });
    }),
    fault("photos", &["gpu"], &["63×63, identity", "palette, identity", "CMYK JPEG, identity", "1×2000, identity"], |c| {
        let reversed = hosts(|cpu, scene, camera| {
            let mut view = cpu.render(scene, camera)?;
            view.rgba.reverse();
            Ok(view)
        });
        photos::run(c, &reversed);
    }),
    // coefficients between the grid's
    fault("quantisation", &["planes"], &["NaN, infinite and huge coefficients"], |c| quantisation::rounding(c, |plane| *plane)),
    // a grid four times as coarse
    fault("quantisation", &["planes"], &["planes on the container's grid"], |c| {
        let coarse = |v: f64| (v / (4.0 * Plane::STEP)).round() * 4.0 * Plane::STEP;
        quantisation::rounding(c, |plane| Plane { a: coarse(plane.a), b: coarse(plane.b), c: coarse(plane.c) });
    }),
    fault("quantisation", &["depth map"], &["disparity as 16 bits"], |c| {
        let eight_bits = |d: &f32| (d * 255.0).round() / 255.0;
        quantisation::sixteen_bits(c, |map| Some(DisparityMap { delta: map.delta.iter().map(eight_bits).collect(), ..*map }));
    }),
    // the nearest layer of all is lost
    fault("quantisation", &["container"], &["identity view"], |c| {
        let models = photos::by_brightness();
        let hole = |file: &[u8], options: &Options| {
            let mut scene = Scene::clone(&*photos::made(&models, file, options)?);
            scene.layers.pop();
            Some(Arc::new(scene))
        };
        quantisation::options(c, hole, &[]);
    }),
    // half the way
    fault("quantisation", &["gpu"], &["views from the corners of the box"], |c| {
        let models = photos::by_brightness();
        let half =
            hosts(|cpu, scene, camera| cpu.render(scene, &Camera { pose: Pose { tx: 0.5 * camera.pose.tx, ..camera.pose }, ..*camera }));
        quantisation::options(c, |file, options| photos::made(&models, file, options), &half);
    }),
    // nothing behind what is near
    fault(
        "corners of the view box",
        &["cpu"],
        &["half-way to them, a disc, holes", "at them, a disc, holes", "at them, a disc, seams"],
        |c| {
            view_box_corners::disc(c, |mut scene| {
                for (class, alpha) in scene.texels.class.iter_mut().zip(&mut scene.texels.alpha).filter(|(c, _)| **c == Class::Hidden as u8)
                {
                    (*class, *alpha) = (Class::Empty as u8, 0);
                }
                scene.texels.hidden.clear();
                scene.layers.iter_mut().for_each(|l| l.first_hidden = 0);
                scene
            });
        },
    ),
];

/// Whether a fault is planted for a kernel.
pub(super) fn covers(kernel: &Kernel) -> bool {
    let subject = if RENDERERS.contains(&kernel.subject) { "gpu" } else { kernel.subject };
    FAULTS.iter().any(|f| f.family == kernel.family && (f.subjects.contains(&subject) || f.subjects.contains(&kernel.subject)))
}

#[test]
fn the_cases_meant_for_a_fault_catch_it() {
    let mut missed: Vec<String> = Vec::new();
    for Fault { family, subjects, cases, run } in FAULTS {
        let mut checked = Checked::default();
        run(&mut checked);
        for (subject, name) in subjects.iter().flat_map(|s| cases.iter().map(move |c| (s, c))) {
            let mut meant = checked.cases.iter().filter(|c| (c.family, c.subject) == (*family, *subject) && c.name.starts_with(name));
            // also if there is none
            if !meant.any(|c| c.verdict == Verdict::Fail) {
                missed.push(format!("{family}, {subject}: {name}"));
            }
        }
    }
    assert!(missed.is_empty(), "{missed:#?}");
}

#[test]
fn a_fault_covers_its_own_kernel_alone() {
    let covered = |family, subject| covers(&Kernel { family, subject, cases: 1, failed: 0, nearest: 0.0, ms: 0.0 });
    assert!(covered("planes", "cpu") && covered("photos", "decoder") && covered("corners of the view box", "cpu"));
    assert!(!covered("visibility", "gpu") && !covered("inpainting", "cpu") && !covered("visibility", "pyramid"));
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

fn hosts(fault: Drawn) -> [Host; 1] {
    [Arc::new(Faulty(Cpu::default(), fault))]
}

impl Renderer for Faulty {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn render(&self, scene: &Arc<Scene>, camera: &Camera) -> Result<View, RenderError> {
        (self.1)(&self.0, scene, camera)
    }
}
