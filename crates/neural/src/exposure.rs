//! Gains of each photograph, learned with the scene: a phone sets exposure and white balance anew as it moves.
//!
//! A pixel of view i shows `exp(g_i) C`, with C the colour of the scene and three numbers g_i a view. A loss with
//! derivatives `d` by what is shown asks `d exp(g_i)` of C and `d C exp(g_i)` of g_i, channel by channel. Nothing fixes the
//! scene's own brightness, so the mean of g over the trained photographs is taken away after each step; what was not
//! trained on is shown with a gain of one.

use crate::adam::{AdamOptions, Parameters};
use crate::dataset::RayDataset;

/// The gains, all one at the start; of no view at all where they are not learned.
#[derive(Debug, Clone, Default)]
pub struct Exposures {
    /// g, three numbers a view.
    pub logarithms: Parameters,
}

impl Exposures {
    /// For all views of a data set, where they are `learned`.
    pub fn new(learned: bool, data: &RayDataset) -> Self {
        let views = if learned { data.views().len() } else { 0 };
        Self { logarithms: Parameters::new(vec![0.0; 3 * views]) }
    }

    /// Gains of a view.
    pub fn gain(&self, view: u32) -> [f32; 3] {
        let first = 3 * view as usize;
        match self.logarithms.values.get(first..first + 3) {
            Some(g) => [g[0].exp(), g[1].exp(), g[2].exp()],
            None => [1.0; 3],
        }
    }

    /// Adds what the loss asks of a view's logarithms.
    pub fn add(&mut self, view: u32, gradient: [f32; 3]) {
        let first = 3 * view as usize;
        if let Some(grads) = self.logarithms.grads.get_mut(first..first + 3) {
            grads.iter_mut().zip(gradient).for_each(|(sum, g)| *sum += g);
        }
    }

    /// One Adam step, number `t` from 1.
    pub fn step(&mut self, data: &RayDataset, learning_rate: f32, t: u64) {
        if self.logarithms.values.is_empty() {
            return;
        }
        self.logarithms.step(&AdamOptions { beta2: 0.99, ..AdamOptions::default() }, learning_rate, t);
        let (training, values) = (data.training(), &mut self.logarithms.values);
        for channel in 0..3 {
            let mean = training.iter().map(|i| values[3 * i + channel]).sum::<f32>() / training.len().max(1) as f32;
            training.iter().for_each(|i| values[3 * i + channel] -= mean);
        }
    }
}

#[cfg(test)]
mod tests {
    use mb_geometry::{ImageSize, Intrinsics, Rigid3};
    use mb_image::Image;
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;

    /// Grey photographs of one scene at known gains: the gains come back, up to the scene's own brightness.
    #[test]
    fn gains_of_grey_photographs_are_found() {
        let gains = [0.8f32, 1.0, 1.3, 0.9, 1.1];
        let images = (0..5)
            .map(|i| {
                let angle = f64::from(i) * 0.4;
                let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), -angle);
                let pose = Rigid3::from_parts(turn, Vector3::new(2.0 * angle.sin(), 0.1, -2.0 * angle.cos()));
                let rgb = Image::from_fn(ImageSize::new(40, 30), |_, _| [128; 3]);
                (rgb, None, Intrinsics { fx: 50.0, fy: 52.0, cx: 19.0, cy: 14.5 }, pose)
            })
            .collect();
        let data = RayDataset::from_images(images, 0).expect("five good views");
        let mut exposures = Exposures::new(true, &data);
        for t in 1..=600 {
            for (view, gain) in gains.iter().enumerate() {
                let shown = exposures.gain(view as u32).map(|g| 0.5 * g);
                exposures.add(view as u32, shown.map(|s| 2.0 * (s - 0.5 * gain) * s));
            }
            exposures.step(&data, 3e-3, t);
        }
        let mean = gains.iter().map(|g| g.ln()).sum::<f32>() / 5.0;
        for (view, gain) in gains.iter().enumerate() {
            let found = exposures.gain(view as u32)[1].ln();
            assert!((found - (gain.ln() - mean)).abs() < 0.05, "{view}: {found} is not {}", gain.ln() - mean);
        }
    }
}
