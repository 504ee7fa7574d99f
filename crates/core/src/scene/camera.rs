//! Cameras, poses and the homography of a plane.

/// Row-major 3×3 matrix.
pub type Mat3 = [[f64; 3]; 3];

/// Product `a · b`.
pub fn mat3_mul(a: &Mat3, b: &Mat3) -> Mat3 {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

/// Product `a · x`.
pub fn mat3_vec(a: &Mat3, x: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| (0..3).map(|k| a[i][k] * x[k]).sum())
}

/// Pinhole intrinsics in pixels. Pixel centres are at half-integers, so the centre of a `w`-pixel row is `w/2`.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Intrinsics {
    /// Horizontal focal length in pixels.
    pub fx: f64,
    /// Vertical focal length in pixels.
    pub fy: f64,
    /// Principal point, in pixels from the left border.
    pub cx: f64,
    /// Principal point, in pixels from the upper border.
    pub cy: f64,
}

impl Intrinsics {
    /// Focal length divided by width, used if neither EXIF nor the user gives one (DESIGN: 0.58 × width).
    pub const DEFAULT_FOCAL_PER_WIDTH: f64 = 0.58;

    /// Square pixels, principal point at the centre, focal length `focal` in pixels.
    pub fn centred(width: u32, height: u32, focal: f64) -> Self {
        Self { fx: focal, fy: focal, cx: f64::from(width) / 2.0, cy: f64::from(height) / 2.0 }
    }

    /// Square pixels and a horizontal field of view of `degrees`, in (0, 180).
    pub fn from_fov_x(width: u32, height: u32, degrees: f64) -> Self {
        let half = f64::from(width) / 2.0;
        Self::centred(width, height, half / (degrees.to_radians() / 2.0).tan())
    }

    /// Horizontal field of view, in degrees, of a picture that is `width` pixels wide.
    pub fn fov_x(&self, width: u32) -> f64 {
        2.0 * (f64::from(width) / 2.0 / self.fx).atan().to_degrees()
    }

    /// The intrinsics for another picture size `(width, height)`: keeps the horizontal field of view, the pixel aspect ratio, and the
    /// principal point's position relative to the centre.
    pub fn resized(&self, from: (u32, u32), to: (u32, u32)) -> Self {
        let s = f64::from(to.0) / f64::from(from.0);
        let off = |c: f64, a: u32, b: u32| f64::from(b) / 2.0 + (c - f64::from(a) / 2.0) * s;
        Self { fx: self.fx * s, fy: self.fy * s, cx: off(self.cx, from.0, to.0), cy: off(self.cy, from.1, to.1) }
    }

    /// The matrix `K`.
    pub fn matrix(&self) -> Mat3 {
        [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
    }

    /// The matrix `K⁻¹`.
    pub fn inverse(&self) -> Mat3 {
        [[1.0 / self.fx, 0.0, -self.cx / self.fx], [0.0, 1.0 / self.fy, -self.cy / self.fy], [0.0, 0.0, 1.0]]
    }

    /// True if all entries are finite and both focal lengths are positive.
    pub fn is_valid(&self) -> bool {
        [self.fx, self.fy, self.cx, self.cy].iter().all(|v| v.is_finite()) && self.fx > 0.0 && self.fy > 0.0
    }
}

/// Position and orientation of a camera in the reference frame. `tx > 0` moves the camera right, so the scene moves left.
///
/// Lengths are in units of the photo's nearest distance, angles in degrees about y, x and z: `yaw > 0` looks right, `pitch > 0` looks up,
/// `roll > 0` turns the camera clockwise.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct Pose {
    /// Translation to the right.
    pub tx: f64,
    /// Translation downwards.
    pub ty: f64,
    /// Translation forwards.
    pub tz: f64,
    /// Rotation about y, in degrees.
    pub yaw: f64,
    /// Rotation about x, in degrees.
    pub pitch: f64,
    /// Rotation about z, in degrees.
    pub roll: f64,
}

impl Pose {
    /// A pure translation of the camera.
    pub fn at(tx: f64, ty: f64, tz: f64) -> Self {
        Self { tx, ty, tz, ..Self::default() }
    }

    /// Orientation `R_c = R_y(yaw) · R_x(pitch) · R_z(roll)`; its columns are the camera's axes in the reference frame.
    pub fn orientation(&self) -> Mat3 {
        let (sy, cy) = self.yaw.to_radians().sin_cos();
        let (sp, cp) = self.pitch.to_radians().sin_cos();
        let (sr, cr) = self.roll.to_radians().sin_cos();
        let ry = [[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]];
        let rx = [[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]];
        let rz = [[cr, -sr, 0.0], [sr, cr, 0.0], [0.0, 0.0, 1.0]];
        mat3_mul(&mat3_mul(&ry, &rx), &rz)
    }

    /// `(R, t)` with `X_t = R X + t`: `R = R_cᵀ`, `t = −R_cᵀ C`.
    pub fn extrinsics(&self) -> (Mat3, [f64; 3]) {
        let rc = self.orientation();
        let r: Mat3 = std::array::from_fn(|i| std::array::from_fn(|j| rc[j][i]));
        let t = mat3_vec(&r, [self.tx, self.ty, self.tz]).map(|v| -v);
        (r, t)
    }

    /// The pose translated by `by`: right, down and forward along the camera's own axes.
    pub fn shifted(&self, by: [f64; 3]) -> Self {
        let [x, y, z] = mat3_vec(&self.orientation(), by);
        Self { tx: self.tx + x, ty: self.ty + y, tz: self.tz + z, ..*self }
    }

    /// True if all entries are finite.
    pub fn is_finite(&self) -> bool {
        [self.tx, self.ty, self.tz, self.yaw, self.pitch, self.roll].iter().all(|v| v.is_finite())
    }
}

/// Half extents of the box of camera positions that a photo is made for, in units of the nearest distance.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct ViewBox {
    /// Half extent to the right and left.
    pub x: f64,
    /// Half extent down and up.
    pub y: f64,
    /// Half extent forward and back.
    pub z: f64,
}

impl ViewBox {
    /// The same half extent along all axes.
    pub const fn cube(half: f64) -> Self {
        Self { x: half, y: half, z: half }
    }
}

/// A target camera: pose, intrinsics and picture size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Position and orientation.
    pub pose: Pose,
    /// Intrinsics in pixels of the picture.
    pub intrinsics: Intrinsics,
    /// Picture width in pixels, at least 1.
    pub width: u32,
    /// Picture height in pixels, at least 1.
    pub height: u32,
}

/// Homography of a plane from reference pixels to target pixels, `H = K_t (R + t mᵀ) K⁻¹` (no division by depth).
///
/// For a reference pixel `(x, y)` in front of the reference camera, `H (x, y, 1)ᵀ = (x_t w, y_t w, w)`. The point is in front of the target
/// camera if and only if `w > 0`; its disparity there is `δ / w`.
pub fn homography(m: [f64; 3], reference: &Intrinsics, camera: &Camera) -> Mat3 {
    let (r, t) = camera.pose.extrinsics();
    let rt: Mat3 = std::array::from_fn(|i| std::array::from_fn(|j| r[i][j] + t[i] * m[j]));
    mat3_mul(&mat3_mul(&camera.intrinsics.matrix(), &rt), &reference.inverse())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Plane;

    fn project(p: &Pose, x: [f64; 3]) -> [f64; 3] {
        let (r, t) = p.extrinsics();
        let y = mat3_vec(&r, x);
        [y[0] + t[0], y[1] + t[1], y[2] + t[2]]
    }

    #[test]
    fn the_scene_moves_opposite_to_the_camera() {
        let moved = project(&Pose::at(0.1, 0.2, 0.3), [0.0, 0.0, 1.0]);
        assert!(moved.iter().zip([-0.1, -0.2, 0.7]).all(|(is, should)| (is - should).abs() < 1e-12), "{moved:?}");
        let yaw = project(&Pose { yaw: 10.0, ..Pose::default() }, [0.0, 0.0, 1.0]);
        assert!(yaw[0] < 0.0, "looking right moves the scene left");
        let pitch = project(&Pose { pitch: 10.0, ..Pose::default() }, [0.0, 0.0, 1.0]);
        assert!(pitch[1] > 0.0, "looking up moves the scene down");
        let roll = project(&Pose { roll: 10.0, ..Pose::default() }, [1.0, 0.0, 1.0]);
        assert!(roll[1] < 0.0, "a camera turned clockwise sees the scene turned anticlockwise");
    }

    #[test]
    fn each_angle_rotates_about_its_axis() {
        let (s, c) = 30f64.to_radians().sin_cos();
        let turned = |pose: Pose| pose.orientation();
        let close = |a: Mat3, b: Mat3| a.as_flattened().iter().zip(b.as_flattened()).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(close(turned(Pose { yaw: 30.0, ..Pose::default() }), [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]));
        assert!(close(turned(Pose { pitch: 30.0, ..Pose::default() }), [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]));
        assert!(close(turned(Pose { roll: 30.0, ..Pose::default() }), [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]));
        // a rotation preserves lengths and angles
        let r = turned(Pose { yaw: 20.0, pitch: -50.0, roll: 70.0, ..Pose::default() });
        let transposed: Mat3 = std::array::from_fn(|i| std::array::from_fn(|j| r[j][i]));
        assert!(close(mat3_mul(&r, &transposed), [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]));
    }

    #[test]
    fn a_resized_camera_keeps_its_field_of_view_and_the_offset_of_its_centre() {
        let k = Intrinsics { fx: 400.0, fy: 390.0, cx: 330.0, cy: 170.0 };
        assert_eq!(k.resized((640, 350), (320, 175)), Intrinsics { fx: 200.0, fy: 195.0, cx: 165.0, cy: 85.0 });
        // another aspect ratio: the field of view stays, and so does the centre
        assert_eq!(k.resized((640, 350), (960, 200)), Intrinsics { fx: 600.0, fy: 585.0, cx: 495.0, cy: 92.5 });
        assert!((k.fov_x(640) - k.resized((640, 350), (960, 200)).fov_x(960)).abs() < 1e-12);
    }

    #[test]
    fn homography_agrees_with_projection() {
        let k = Intrinsics::centred(640, 350, 371.0);
        let cam = Camera {
            pose: Pose { tx: 0.03, ty: -0.02, tz: 0.1, yaw: 3.0, pitch: -2.0, roll: 5.0 },
            intrinsics: Intrinsics::centred(800, 600, 500.0),
            width: 800,
            height: 600,
        };
        let plane = Plane { a: 0.6, b: 0.1, c: -0.05 };
        let (centre, half) = ((96.0, 88.0), 32.0);
        let h = homography(plane.normal(centre, half, &k), &k, &cam);
        let (x, y) = (80.5, 101.5);
        let d = plane.disparity((x - centre.0) / half, (y - centre.1) / half);
        let p = [(x - k.cx) / k.fx / d, (y - k.cy) / k.fy / d, 1.0 / d];
        let q = project(&cam.pose, p);
        let want = (cam.intrinsics.fx * q[0] / q[2] + cam.intrinsics.cx, cam.intrinsics.fy * q[1] / q[2] + cam.intrinsics.cy);
        let g = mat3_vec(&h, [x, y, 1.0]);
        assert!((g[0] / g[2] - want.0).abs() < 1e-9 && (g[1] / g[2] - want.1).abs() < 1e-9);
        assert!((d / g[2] - 1.0 / q[2]).abs() < 1e-12, "δ/w is the disparity in the target camera");
    }
}
