use super::*;
use crate::scenes::shape::Shape;

/// A binary glTF file of a square of 2 × 2 m that stands on the ground; its left half is red and its right half green. `change` edits the
/// JSON.
fn square(up: Up, change: impl Fn(String) -> String) -> Vec<u8> {
    let corner = |x: f32, y: f32| if up == Up::Y { [x, y, 0.5] } else { [x, -0.5, y] };
    let places = [corner(-1.0, 0.0), corner(1.0, 0.0), corner(1.0, 2.0), corner(-1.0, 2.0)];
    let uv = [[0.0f32, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]];
    let mut blob: Vec<u8> = places.iter().flatten().chain(uv.iter().flatten()).flat_map(|v| v.to_le_bytes()).collect();
    blob.extend([0u16, 1, 2, 0, 2, 3].iter().flat_map(|v| v.to_le_bytes()));
    let picture = image::RgbaImage::from_fn(16, 16, |x, _| image::Rgba(if x < 8 { [255, 0, 0, 255] } else { [0, 255, 0, 0] }));
    let mut png = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut png, image::ImageFormat::Png).unwrap();
    let png = png.into_inner();
    blob.extend(&png);
    blob.resize(blob.len().next_multiple_of(4), 0);
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0,"translation":[3,0,0]}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"TEXCOORD_0":1}},"indices":2,"material":0}}]}}],
        "materials":[{{"pbrMetallicRoughness":{{"baseColorTexture":{{"index":0}}}}}}],"textures":[{{"source":0}}],
        "images":[{{"bufferView":3,"mimeType":"image/png"}}],"buffers":[{{"byteLength":{all}}}],
        "bufferViews":[{{"buffer":0,"byteOffset":0,"byteLength":48}},{{"buffer":0,"byteOffset":48,"byteLength":32}},
        {{"buffer":0,"byteOffset":80,"byteLength":12}},{{"buffer":0,"byteOffset":92,"byteLength":{png}}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","min":[-1,-1,-1],"max":[1,2,2]}},
        {{"bufferView":1,"componentType":5126,"count":4,"type":"VEC2"}},{{"bufferView":2,"componentType":5123,"count":6,"type":"SCALAR"}}]}}"#,
        all = blob.len(),
        png = png.len(),
    );
    let mut json = change(json).into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let chunk = |kind: &[u8; 4], data: &[u8]| [&(data.len() as u32).to_le_bytes()[..], kind, data].concat();
    let body = [chunk(b"JSON", &json), chunk(b"BIN\0", &blob)].concat();
    [&b"glTF"[..], &2u32.to_le_bytes(), &(body.len() as u32 + 12).to_le_bytes(), &body].concat()
}

#[test]
fn models_stand_on_the_ground_and_can_be_hit() {
    for up in [Up::Y, Up::Z] {
        let model = Model::read(&square(up, |j| j), up).unwrap();
        assert_eq!(model.size().map(|m| (m * 1e6).round() as u32), [2_000_000, 2_000_000, 0], "{up:?}");
        let shape = Shape::Mesh(model.parts[0].clone(), 2.0);
        // at scale 2: 4 × 4 m, x from −2 to 2, y from −4 to 0, at z = 0; seen from 5 m in front
        let colour = |x: f64, y: f64| {
            let (t, n, triangle) = shape.hit_triangle(v3(x, y, -5.0), v3(0.0, 0.0, 2.0), 1e-4, 10.0)?;
            assert!((t - 2.5).abs() < 1e-12 && (n.z.abs() - 1.0).abs() < 1e-12, "{t} {n:?}");
            Some(model.parts[0].colour(triangle, v3(x, y, 0.0) * 0.5, 1e-3).array().map(|c| (c * 10.0).round()))
        };
        assert_eq!(colour(-1.0, -1.0), Some([10.0, 0.0, 0.0]), "{up:?}");
        assert_eq!(colour(1.5, -3.9), Some([0.0, 10.0, 0.0]), "{up:?}");
        assert_eq!([colour(-2.1, -1.0), colour(0.0, 0.1), colour(0.0, -4.1)], [None; 3], "{up:?}");
    }
}

#[test]
fn transparent_texels_are_not_hit() {
    let cut = |mode: &str| {
        let with = |j: String| j.replace(r#""materials":[{"#, &format!(r#""materials":[{{"alphaMode":"{mode}","#));
        let model = Model::read(&square(Up::Y, with), Up::Y).unwrap();
        let hit = |x: f64| model.parts[0].hit(v3(x, -1.0, -1.0), v3(0.0, 0.0, 1.0), 0.0, 9.0).is_some();
        [hit(-0.5), hit(0.5)]
    };
    assert_eq!(cut("OPAQUE"), [true, true]);
    assert_eq!(cut("MASK"), [true, false]);
    assert_eq!(cut("BLEND"), [true, false]);
}

#[test]
fn broken_files_say_what_is_wrong() {
    let error = |change: &dyn Fn(String) -> String| Model::read(&square(Up::Y, change), Up::Y).unwrap_err().to_string();
    for (change, expected) in [
        (("\"scene\":0", "\"scene\":7"), "invalid glTF"),
        (("\"asset\"", "\"extensionsRequired\":[\"EXT_meshopt_compression\"],\"asset\""), "invalid glTF"),
        (("\"byteOffset\":0,\"byteLength\":48", "\"byteOffset\":99999,\"byteLength\":48"), "the position data"),
        (("\"byteOffset\":80", "\"byteOffset\":81"), "a vertex"),
        (("\"componentType\":5123", "\"componentType\":5126"), "the index data"),
        (("\"byteOffset\":92", "\"byteOffset\":90"), "a texture cannot be decoded"),
        (("\"bufferView\":3,\"mimeType\":\"image/png\"", "\"uri\":\"secret.png\""), "a texture is missing from the file"),
        (("\"translation\":[3,0,0]", "\"scale\":[1e38,1e38,1e38],\"translation\":[1e38,0,0]"), "farther than 10000 m"),
        (("\"count\":6", "\"count\":2"), "no triangles"),
    ] {
        let text = error(&|j: String| {
            assert!(j.contains(change.0), "{}", change.0);
            j.replace(change.0, change.1)
        });
        assert!(text.contains(expected), "{}: {text}", change.1);
    }
    for cut in [0, 11, 12, 40, 400] {
        assert!(Model::read(&square(Up::Y, |j| j)[..cut], Up::Y).is_err(), "{cut} bytes");
    }
}

#[test]
fn models_replace_only_objects_of_similar_size() {
    let models = Models::new(vec![Model::read(&square(Up::Y, |j| j), Up::Y).unwrap()]);
    let rng = Rng::new(1);
    let share = |size: f64| (0..400).filter(|_| models.similar(&rng, size).is_some()).count();
    assert!((150..250).contains(&share(2.0)) && (150..250).contains(&share(1.4)));
    assert_eq!([share(0.5), share(8.0)], [0, 0]);
    // without models, the generator does not advance, so scenes do not change
    let (a, b) = (Rng::new(7), Rng::new(7));
    assert!(
        Models::default().similar(&a, 2.0).is_none() && Models::default().furnished(&a, 1.0).is_none() && models.similar(&a, 9.0).is_none()
    );
    assert_eq!(a.next(), b.next());
}

#[test]
fn scenes_show_their_models() {
    use crate::scenes::{Assets, Scene};
    let models = Models::new(vec![Model::read(&square(Up::Y, |j| j), Up::Y).unwrap()]);
    let assets = Assets { models, ..Assets::default() };
    let (mut other, mut shown) = (0, 0);
    for seed in 0..40 {
        let (plain, with) = (Scene::framed(seed, 48, 32), Scene::of(seed, 48, 32, &assets));
        let (plain, with) = (plain.render(&plain.camera(), 1), with.render(&with.camera(), 1));
        assert!(with.disparity.delta.iter().all(|d| d.is_finite() && (0.0..=1.0 + 1e-6).contains(d)), "seed {seed}");
        other += usize::from(plain != with);
        // nothing else in scenes is as red or green
        shown += usize::from(with.photo.rgb.iter().filter(|[r, g, b]| *b < 20 && r.max(g) > &120 && r.min(g) < &20).count() > 8);
    }
    assert!(other >= 8 && shown >= 4, "{other} scenes differ, {shown} show a model");
}
