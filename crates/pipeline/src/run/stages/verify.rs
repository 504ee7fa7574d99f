//! What a made photo shows, against what it was made of.

use tmpi_core::Scene;
use tmpi_core::container::Carried;
use tmpi_render::difference::psnr;
use tmpi_render::draw_reference_view;

use super::Encoded;
use crate::run::{Context, MakeError, Stage, prune};

/// Measures the identity view, the carried photo and, where it is asked for, what leaving out changed.
#[derive(Debug, Default)]
pub struct Verify;

impl Stage for Verify {
    const NAME: &'static str = "verify";
    type Input<'a> = &'a Encoded;
    type Output = ();

    fn run(&mut self, made: &Encoded, context: &mut Context) -> Result<(), MakeError> {
        let (identity, codec) = rayon::join(|| identity_psnr(&made.scene), || codec_psnr(&made.scene, &made.carried));
        let error = &mut context.report.error;
        (error.identity_psnr, error.codec_psnr) = (identity?, codec?);
        if context.options.verify_prune {
            let change = prune::verify(&made.scene.photo, &made.geometry)?;
            error.prune_max_abs = Some(change.max_abs.into());
            error.prune_share_off = Some(change.share);
        }
        Ok(())
    }
}

fn identity_psnr(scene: &Scene) -> Result<f64, MakeError> {
    let view = draw_reference_view(scene)?;
    let rgb: Vec<[u8; 3]> = view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect();
    Ok(psnr(rgb.as_flattened(), scene.photo.rgb.as_flattened()))
}

fn codec_psnr(scene: &Scene, carried: &Carried) -> Result<f64, MakeError> {
    Ok(psnr(carried.decode()?.rgb.as_flattened(), scene.photo.rgb.as_flattened()))
}
