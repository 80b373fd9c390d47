//! The built-in model: a small castle that needs no parts library.

use crate::model::Model;
use crate::sketch::Sketch;

const GREEN: u32 = 2;
const BLACK: u32 = 0;
const RED: u32 = 4;
const BROWN: u32 = 70;
const YELLOW: u32 = 14;
const WHITE: u32 = 15;
const TAN: u32 = 19;
const LIME: u32 = 27;
const GREY: u32 = 71;
const DARK_GREY: u32 = 72;
const DARK_RED: u32 = 320;
const DARK_BLUE: u32 = 272;
const WINDOW: u32 = 43;

/// A castle of about a hundred bricks, 13 cm long and 11 cm high: a tower with battlements, a house with a pointed
/// door, stairs to a column, trees. Every brick sits on studs, so it can be built.
pub fn demo_model() -> Model {
    let mut sketch = Sketch::new("MobileBrick demo castle");
    ground(&mut sketch);
    tower(&mut sketch);
    house(&mut sketch);
    stairs_and_column(&mut sketch);
    garden(&mut sketch);
    Model::from_text(&sketch.finish(), "demo.ldr", None).expect("the built-in model is valid")
}

fn ground(sketch: &mut Sketch) {
    for (x, z) in [(4.0, 3.0), (12.0, 3.0), (4.0, 9.0), (12.0, 9.0)] {
        sketch.put("3036", GREEN, [x, z], 1, 0);
    }
    sketch.step();
    sketch.put("3029", TAN, [8.0, 6.0], 2, 0);
    sketch.step();
}

fn tower(sketch: &mut Sketch) {
    for course in 0..7 {
        let top = 4 + 3 * course;
        let colors = if course % 3 == 1 { [DARK_GREY, GREY] } else { [GREY, GREY] };
        if course % 2 == 0 {
            sketch.put("3001", colors[0], [3.0, 9.0], top, 0).put("3001", colors[1], [3.0, 11.0], top, 0);
        } else {
            sketch.put("3001", colors[0], [2.0, 10.0], top, 1).put("3001", colors[1], [4.0, 10.0], top, 1);
        }
        sketch.step();
    }
    sketch.put("3958", DARK_GREY, [3.0, 10.0], 23, 0).step();
    for (x, z) in [(0.5, 7.5), (5.5, 7.5), (0.5, 12.5), (5.5, 12.5)] {
        sketch.put("3005", GREY, [x, z], 26, 0);
    }
    sketch.put("3004", GREY, [3.0, 7.5], 26, 0).put("3004", GREY, [3.0, 12.5], 26, 0);
    sketch.put("3004", GREY, [0.5, 10.0], 26, 1).put("3004", GREY, [5.5, 10.0], 26, 1);
    sketch.step();
    for x in [2.0, 4.0] {
        sketch.put("3039", DARK_BLUE, [x, 9.5], 26, 0).put("3039", DARK_BLUE, [x, 10.5], 26, 2);
    }
    sketch.step();
    sketch.put("3020", DARK_BLUE, [3.0, 10.0], 27, 0).step();
    sketch.put("87580", DARK_BLUE, [3.0, 10.0], 28, 0);
    sketch.put("3069b", DARK_BLUE, [1.5, 10.0], 28, 1).put("3069b", DARK_BLUE, [4.5, 10.0], 28, 1);
    sketch.step();
    sketch.put("3062b", WHITE, [3.0, 10.0], 31, 0).put("59900", YELLOW, [3.0, 10.0], 34, 0).step();
}

fn house(sketch: &mut Sketch) {
    // Walls 8 by 4 studs, the door between x = 10 and 12 of the front wall; courses overlap at the corners.
    sketch.put("3622", TAN, [8.5, 8.5], 4, 0).put("3622", TAN, [13.5, 8.5], 4, 0);
    sketch.put("3004", TAN, [7.5, 10.0], 4, 1).put("3004", TAN, [14.5, 10.0], 4, 1);
    sketch.put("3008", TAN, [11.0, 11.5], 4, 0).step();
    sketch.put("3004", TAN, [9.0, 8.5], 7, 0).put("3004", TAN, [13.0, 8.5], 7, 0);
    sketch.put("3010", TAN, [7.5, 10.0], 7, 1).put("3010", TAN, [14.5, 10.0], 7, 1);
    sketch.put("3009", TAN, [11.0, 11.5], 7, 0).step();
    for (corner, window) in [(7.5, 9.0), (14.5, 13.0)] {
        sketch.put("3005", TAN, [corner, 8.5], 10, 0).put("3004", WINDOW, [window, 8.5], 10, 0);
        sketch.put("3004", TAN, [corner, 10.0], 10, 1);
    }
    sketch.put("3008", TAN, [11.0, 11.5], 10, 0).step();
    // Inverted slopes lean towards each other over the door.
    sketch.put("3005", TAN, [8.5, 8.5], 13, 0).put("3005", TAN, [13.5, 8.5], 13, 0);
    sketch.put("3665a", WHITE, [9.5, 8.5], 13, 3).put("3665a", WHITE, [12.5, 8.5], 13, 1);
    sketch.put("3010", TAN, [7.5, 10.0], 13, 1).put("3010", TAN, [14.5, 10.0], 13, 1);
    sketch.put("3009", TAN, [11.0, 11.5], 13, 0).step();
    sketch.put("3008", BROWN, [11.0, 8.5], 16, 0).put("3008", BROWN, [11.0, 11.5], 16, 0);
    sketch.put("3004", BROWN, [7.5, 10.0], 16, 1).put("3004", BROWN, [14.5, 10.0], 16, 1).step();
    for x in [9.0, 13.0] {
        sketch.put("3037", RED, [x, 9.5], 19, 0).put("3037", RED, [x, 10.5], 19, 2);
    }
    sketch.step();
    sketch.put("3034", DARK_RED, [11.0, 10.0], 20, 0).step();
    sketch.put("6636", DARK_RED, [10.0, 9.5], 21, 0).put("6636", DARK_RED, [10.0, 10.5], 21, 0);
    sketch.put("3003", GREY, [14.0, 10.0], 23, 0).step();
    sketch.put("3022", DARK_GREY, [14.0, 10.0], 24, 0).step();
    sketch.put("6141", BLACK, [13.5, 9.5], 25, 0).put("6141", BLACK, [14.5, 10.5], 25, 0).step();
}

fn stairs_and_column(sketch: &mut Sketch) {
    sketch.put("3022", WHITE, [4.0, 2.0], 2, 0).put("3022", WHITE, [6.0, 2.0], 2, 0).step();
    sketch.put("3022", WHITE, [6.0, 2.0], 3, 0).put("3003", WHITE, [8.0, 2.0], 4, 0);
    sketch.put("3003", GREY, [10.0, 2.0], 4, 0).put("3003", GREY, [12.0, 2.0], 4, 0).step();
    sketch.put("3020", WHITE, [11.0, 2.0], 5, 0).step();
    sketch.put("3941", TAN, [12.0, 2.0], 8, 0).step();
    sketch.put("4032a", TAN, [12.0, 2.0], 9, 0).put("4150", DARK_BLUE, [12.0, 2.0], 10, 0).step();
}

fn garden(sketch: &mut Sketch) {
    for (x, z, leaves) in [(1.5, 1.5, LIME), (15.5, 2.5, GREEN), (15.5, 6.5, LIME)] {
        sketch.put("3062b", BROWN, [x, z], 4, 0).put("3062b", leaves, [x, z], 7, 0);
        sketch.put("3062b", leaves, [x, z], 10, 0).put("59900", leaves, [x, z], 13, 0).step();
    }
    for (x, z, petals) in
        [(0.5, 4.5, RED), (1.5, 6.5, YELLOW), (0.5, 7.5, WHITE), (14.5, 4.5, RED), (15.5, 8.5, YELLOW), (6.5, 0.5, RED)]
    {
        sketch.put("6141", petals, [x, z], 2, 0);
    }
    sketch.put("54200", DARK_GREY, [14.5, 0.5], 1, 0).step();
}
