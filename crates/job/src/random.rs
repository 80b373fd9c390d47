//! Random numbers that depend on a seed and a stream, never on threads.

use rand::SeedableRng;

/// The project's generator: ChaCha with 8 rounds, the same bytes on every platform and in every version.
pub type Rng = rand_chacha::ChaCha8Rng;

/// A generator for `stream` of `seed`. Work that runs in parallel takes one stream per piece (frame, chunk), so that
/// the result does not depend on how the pieces were scheduled.
pub fn rng(seed: u64, stream: u64) -> Rng {
    let mut rng = Rng::seed_from_u64(seed);
    rng.set_stream(stream);
    rng
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn streams_differ_and_repeat() {
        let draw = |seed, stream| rng(seed, stream).random::<u64>();
        assert_eq!(draw(1, 2), draw(1, 2));
        assert_ne!(draw(1, 2), draw(1, 3));
        assert_ne!(draw(1, 2), draw(2, 2));
    }
}
