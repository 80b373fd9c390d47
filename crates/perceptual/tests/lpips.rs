//! LPIPS against the published implementation's values, and weights that are not as they should be.

use std::path::{Path, PathBuf};

use mb_eval::{ColorImage, PerceptualMetric, ViewsOptions, evaluate_views};
use mb_geometry::ImageSize;
use mb_image::read_rgb_fraction;
use mb_job::Silent;
use mb_perceptual::{Lpips, LpipsNet};
use serde_json::Value;

const NETS: [LpipsNet; 3] = [LpipsNet::Vgg, LpipsNet::Alex, LpipsNet::Squeeze];

fn weights(folder: &Path, net: LpipsNet) -> PathBuf {
    folder.join(format!("lpips_random_{}_f16.safetensors", net.name()))
}

#[test]
fn the_published_implementation_agrees() {
    let Some(folder) = mb_testdata::find("official_scorer/nvs") else { return };
    let expected: Value = serde_json::from_slice(&std::fs::read(folder.join("expected_nvs.json")).unwrap()).unwrap();
    let expected = &expected["pair"];
    let gt = read_rgb_fraction(folder.join("gt_000000.png")).unwrap();
    let render = read_rgb_fraction(folder.join("render_000000.png")).unwrap();
    for net in NETS {
        let lpips = Lpips::read(net, &[weights(&folder, net)]).unwrap();
        let key = format!("lpips_{}", net.name());
        let close = |found: f64, expected: &Value, what: &str| {
            let expected = expected.as_f64().unwrap();
            assert!((found - expected).abs() < 1e-5 * expected, "{key} {what} is {found}, not {expected}");
        };
        close(lpips.distance(&render, &gt).unwrap(), &expected[&key], "in all");
        let layers = lpips.layer_distances(&render, &gt).unwrap();
        let expected_layers = expected[format!("{key}_per_layer")].as_array().unwrap();
        assert_eq!(layers.len(), expected_layers.len());
        for (k, (found, expected)) in layers.iter().zip(expected_layers).enumerate() {
            close(*found, expected, &format!("layer {k}"));
        }
        assert_eq!(lpips.distance(&gt, &gt).unwrap(), 0.0);
        let swapped = lpips.distance(&gt, &render).unwrap();
        close(swapped, &expected[&key], "with the images swapped");
    }
    // The same through the scores of views.
    let lpips = Lpips::read(LpipsNet::Alex, &[weights(&folder, LpipsNet::Alex)]).unwrap();
    let scores = evaluate_views(&folder, &folder, &ViewsOptions::default(), Some(&lpips), &Silent).unwrap();
    assert!((scores.lpips.unwrap() - expected["lpips_alex"].as_f64().unwrap()).abs() < 1e-7);
    assert!(scores.lpips_net.unwrap().starts_with("lpips-alex"));
}

#[test]
fn converted_weights_are_the_same_weights() {
    let Some(folder) = mb_testdata::find("official_scorer/nvs") else { return };
    let dir = tempfile::tempdir().unwrap();
    for net in [LpipsNet::Alex, LpipsNet::Squeeze] {
        let original = Lpips::read(net, &[weights(&folder, net)]).unwrap();
        let path = dir.path().join("weights.safetensors");
        original.write_safetensors(&path).unwrap();
        let converted = Lpips::read(net, std::slice::from_ref(&path)).unwrap();
        assert_eq!(converted.report().probe, original.report().probe);
        assert_eq!(converted.report().parameters, original.report().parameters);
        assert!(original.report().probe > 0.0);
    }
}

#[test]
fn weights_of_another_network_are_refused() {
    let Some(folder) = mb_testdata::find("official_scorer/nvs") else { return };
    let refusal = |net, file| Lpips::read(net, &[weights(&folder, file)]).err().unwrap().to_string();
    let message = refusal(LpipsNet::Vgg, LpipsNet::Alex);
    assert!(message.contains("0.weight") && message.contains("another network"), "{message}");
    assert!(refusal(LpipsNet::Squeeze, LpipsNet::Vgg).contains("3.squeeze.weight"));
}

#[test]
fn images_too_small_or_unequal_are_refused() {
    let Some(folder) = mb_testdata::find("official_scorer/nvs") else { return };
    let lpips = Lpips::read(LpipsNet::Alex, &[weights(&folder, LpipsNet::Alex)]).unwrap();
    let grey = |width, height| ColorImage::filled(ImageSize::new(width, height), [0.5; 3]);
    assert!(lpips.distance(&grey(8, 8), &grey(8, 8)).unwrap_err().to_string().contains("too small"));
    assert!(lpips.distance(&grey(64, 64), &grey(64, 65)).unwrap_err().to_string().contains("different sizes"));
}

/// A safetensors file from its header and the number of data bytes behind it.
fn safetensors(header: &str, data: usize) -> Vec<u8> {
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend_from_slice(header.as_bytes());
    bytes.resize(bytes.len() + data, 0);
    bytes
}

#[test]
fn damaged_files_of_weights_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("weights.bin");
    let entry = |shape: &str, from: usize, to: usize| {
        format!(r#"{{"0.weight":{{"dtype":"F32","shape":{shape},"data_offsets":[{from},{to}]}}}}"#)
    };
    for (bytes, expected) in [
        (Vec::new(), "neither a safetensors nor a PyTorch file"),
        (b"\x89PNG\r\n\x1a\nnot weights".to_vec(), "neither"),
        (vec![0xff; 64], "neither"),
        (safetensors(&entry("[2,2]", 0, 16), 12), "truncated"),
        (safetensors(&entry("[2,2]", 0, 12), 12), "for the shape"),
        (safetensors(&entry("[2,2]", 12, 0), 12), "truncated"),
        (safetensors(&entry("[18446744073709551615,2]", 0, 12), 12), "for the shape"),
        (safetensors(r#"{"a":{"dtype":"I64","shape":[1],"data_offsets":[0,8]}}"#, 8), "numbers of type I64"),
        (
            safetensors(
                r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]},"b":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#,
                8,
            ),
            "overlap",
        ),
        (safetensors("{}", 0), "the weights 0.weight are missing"),
        (b"PK\x03\x04nothing more".to_vec(), "archive is damaged"),
        (b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.".to_vec(), "truncated"),
        (
            b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.K\x01.}.cos\nsystem\n(S'echo'\ntR.".to_vec(),
            "os.system",
        ),
    ] {
        std::fs::write(&path, &bytes).unwrap();
        let message = Lpips::read(LpipsNet::Alex, std::slice::from_ref(&path)).err().unwrap().to_string();
        assert!(message.contains(expected) && message.contains("weights.bin"), "{message} lacks '{expected}'");
    }
}
