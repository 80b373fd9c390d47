//! The samples of a tile of rays, one ray after the other.

/// Samples in order of their rays, and along each ray in order of distance. Positions have `N` coordinates.
#[derive(Debug, Default)]
pub struct RaySamples<const N: usize> {
    /// Where each sample lies.
    pub positions: Vec<[f32; N]>,
    /// Its distance from the camera.
    pub depths: Vec<f32>,
    /// The length of the stretch that it stands for.
    pub lengths: Vec<f32>,
    /// Number of samples and (unit) direction of each ray.
    pub runs: Vec<(u32, [f32; 3])>,
    /// Samples that belong to an ended ray.
    ended: usize,
    keep: Vec<u32>,
}

impl<const N: usize> RaySamples<N> {
    /// Number of samples.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there is no sample.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Forgets all rays.
    pub fn clear(&mut self) {
        self.positions.clear();
        self.depths.clear();
        self.lengths.clear();
        self.runs.clear();
        self.ended = 0;
    }

    /// Adds a sample to the ray that has begun.
    pub fn push(&mut self, position: [f32; N], depth: f32, length: f32) {
        self.positions.push(position);
        self.depths.push(depth);
        self.lengths.push(length);
    }

    /// Ends the ray; what is pushed next belongs to another.
    pub fn end_ray(&mut self, direction: [f32; 3]) {
        self.runs.push(((self.len() - self.ended) as u32, direction));
        self.ended = self.len();
    }

    /// The numbers of each ray's samples.
    pub fn ranges(&self) -> impl Iterator<Item = std::ops::Range<usize>> + '_ {
        self.runs.iter().scan(0, |first, (count, _)| {
            let range = *first..*first + *count as usize;
            *first = range.end;
            Some(range)
        })
    }

    /// Drops samples: `choose` adds the numbers of those to keep of a ray, in ascending order. Returns the numbers of all that
    /// are left, or `None` where nothing was dropped.
    pub fn retain(&mut self, mut choose: impl FnMut(std::ops::Range<usize>, &mut Vec<u32>)) -> Option<&[u32]> {
        self.keep.clear();
        let mut first = 0;
        for (count, _) in &mut self.runs {
            let (last, before) = (first + *count as usize, self.keep.len());
            choose(first..last, &mut self.keep);
            *count = (self.keep.len() - before) as u32;
            first = last;
        }
        if self.keep.len() == self.positions.len() {
            return None;
        }
        for (to, from) in self.keep.iter().enumerate() {
            let from = *from as usize;
            self.positions[to] = self.positions[from];
            self.depths[to] = self.depths[from];
            self.lengths[to] = self.lengths[from];
        }
        self.positions.truncate(self.keep.len());
        self.depths.truncate(self.keep.len());
        self.lengths.truncate(self.keep.len());
        self.ended = self.keep.len();
        Some(&self.keep)
    }

    /// Drops what no light reaches: samples behind the point where less than `dark` of it is left. `passed` is the share that
    /// passes a sample, given the number of the next one of its ray. Returns as [`Self::retain`].
    pub fn drop_dark(&mut self, dark: f32, passed: impl Fn(usize, Option<usize>) -> f32) -> Option<&[u32]> {
        self.retain(|range, keep| {
            let (mut light, last) = (1.0, range.end);
            for i in range {
                if light < dark {
                    break;
                }
                keep.push(i as u32);
                light *= passed(i, (i + 1 < last).then_some(i + 1));
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn three_rays() -> RaySamples<3> {
        let mut samples = RaySamples::default();
        for (ray, count) in [3, 0, 4].into_iter().enumerate() {
            for i in 0..count {
                samples.push([ray as f32, i as f32, 0.0], i as f32, 0.5);
            }
            samples.end_ray([0.0, 0.0, 1.0]);
        }
        samples
    }

    #[test]
    fn rays_keep_their_own_samples() {
        let mut samples = three_rays();
        assert_eq!(samples.ranges().collect::<Vec<_>>(), [0..3, 3..3, 3..7]);
        // Half of the light passes a sample: an eighth is left behind the third.
        let left = samples.drop_dark(0.2, |_, _| 0.5).unwrap().to_vec();
        assert_eq!(left, [0, 1, 2, 3, 4, 5]);
        assert_eq!(samples.ranges().collect::<Vec<_>>(), [0..3, 3..3, 3..6]);
        assert_eq!(samples.positions[5], [2.0, 2.0, 0.0]);
        assert!(samples.drop_dark(0.0, |_, _| 0.5).is_none());
        samples.push([9.0; 3], 9.0, 0.5);
        samples.end_ray([1.0, 0.0, 0.0]);
        assert_eq!(samples.ranges().last(), Some(6..7));
    }

    #[test]
    fn the_last_sample_of_a_ray_has_no_next() {
        let mut samples = three_rays();
        let nexts = std::cell::RefCell::new(Vec::new());
        samples.drop_dark(0.0, |i, next| {
            nexts.borrow_mut().push((i, next));
            1.0
        });
        assert_eq!(
            nexts.into_inner().iter().filter(|(_, next)| next.is_none()).map(|(i, _)| *i).collect::<Vec<_>>(),
            [2, 6]
        );
    }
}
