//! Booklets as files: valid, complete, the same each time, whatever the model.

use std::sync::LazyLock;

use mb_bricks::Model;
use mb_instructions::{BookletSummary, Form, Plan, booklet, list_notes, shopping_list, wanted_list, write_booklet};
use mb_job::Silent;

const TOWER: &str = "0 A <small> & fine tower\n1 4 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n0 STEP\n\
                     1 15 0 -24 0 1 0 0 0 1 0 0 0 1 3001.dat\n1 47 0 -48 0 1 0 0 0 1 0 0 0 1 3003.dat\n";

fn model(text: &str) -> Model {
    Model::from_text(text, "tower.ldr", None).expect("a model")
}

fn bytes(text: &str, form: Form) -> (Vec<u8>, BookletSummary) {
    let model = model(text);
    booklet(&model, &Plan::of(&model), form, &Silent).expect("a booklet")
}

/// The tower's booklets, drawn once.
static PDF: LazyLock<(Vec<u8>, BookletSummary)> = LazyLock::new(|| bytes(TOWER, Form::Pdf));
static HTML: LazyLock<(Vec<u8>, BookletSummary)> = LazyLock::new(|| bytes(TOWER, Form::Html));

fn count(haystack: &[u8], needle: &str) -> usize {
    haystack.windows(needle.len()).filter(|window| *window == needle.as_bytes()).count()
}

#[test]
fn a_pdf_has_a_header_its_pages_and_an_end() {
    let (pdf, summary) = &*PDF;
    assert!(pdf.starts_with(b"%PDF-"));
    assert!(pdf.trim_ascii_end().ends_with(b"%%EOF"));
    assert_eq!(count(pdf, "/Type/Page/") + count(pdf, "/Type /Page\n"), summary.pages, "one object a page");
    assert!(count(pdf, "/Subtype /Image") + count(pdf, "/Subtype/Image") >= 7, "pictures are inside");
    assert_eq!((summary.parts, summary.steps, summary.bytes), (3, 2, pdf.len()));
    assert!(pdf.len() < 1_500_000, "{} bytes for three bricks", pdf.len());
}

#[test]
fn a_page_is_well_formed_and_needs_nothing_else() {
    let (page, summary) = &*HTML;
    let page = str::from_utf8(page).unwrap();
    assert_eq!(page.matches("<svg class=\"page\"").count(), summary.pages);
    assert!(page.contains("A &lt;small&gt; &amp; fine tower") && !page.contains("<small>"));
    for outside in ["src=\"http", "href=\"http", "url(http", "<script"] {
        assert!(!page.contains(outside), "{outside}");
    }
    for tag in ["svg", "text", "defs", "body", "html"] {
        let open = page.matches(&format!("<{tag} ")).count() + page.matches(&format!("<{tag}>")).count();
        assert_eq!(open, page.matches(&format!("</{tag}>")).count(), "{tag}");
    }
    // What is used was defined.
    for used in page.split("<use href=\"#").skip(1) {
        let id = used.split('"').next().unwrap();
        assert!(page.contains(&format!("<image id=\"{id}\"")), "{id}");
    }
}

#[test]
fn the_same_model_gives_the_same_bytes_on_one_thread_and_on_many() {
    let run = |threads, form| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| bytes(TOWER, form).0)
    };
    assert!(run(1, Form::Pdf) == PDF.0);
    assert!(run(3, Form::Html) == HTML.0);
}

#[test]
fn models_without_parts_with_missing_parts_and_with_strange_colours_give_booklets() {
    let strange = "1 9999 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n1 0x2FF8800 0 -24 0 1 0 0 0 1 0 0 0 1 3001.dat\n\
                   1 16 0 -48 0 1 0 0 0 1 0 0 0 1 nosuchpart.dat\n1 16 0 -72 0 1 0 0 0 1 0 0 0 1 3001.dat\n";
    for form in [Form::Pdf, Form::Html] {
        let (bytes, summary) = bytes("3 4 0 0 0 20 0 0 0 0 20\n", form);
        assert!(!bytes.is_empty() && summary.pages >= 2);
    }
    let (page, summary) = bytes(strange, Form::Html);
    assert!(str::from_utf8(&page).unwrap().contains("Incomplete: 1 part is missing"));
    assert!(
        str::from_utf8(&page).unwrap().contains("in no step") && str::from_utf8(&page).unwrap().contains("nosuchpart")
    );
    assert_eq!((summary.parts, summary.missing_parts), (3, 1));
    assert!(
        str::from_utf8(&page).unwrap().contains("<title>tower</title>"),
        "the file's name for want of a better one"
    );
    assert!(summary.warnings.iter().any(|w| w.contains("nosuchpart.dat")));
    let model = model(strange);
    let notes = list_notes(&model, &Plan::of(&model));
    assert_eq!(notes.unmapped_colors, ["0x2FF8800 #FF8800", "16 Uncoloured", "9999 Unknown 9999"]);
    assert_eq!(notes.missing_parts, ["nosuchpart.dat"]);
}

#[test]
fn missing_parts_stand_in_the_lists_as_often_as_they_are_used() {
    // Two uses of a submodel that lacks a part in the colour of its use, and one more in red.
    let text = "0 FILE main.ldr\n1 4 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n1 1 0 -24 0 1 0 0 0 1 0 0 0 1 sub.ldr\n\
                1 1 0 -72 0 1 0 0 0 1 0 0 0 1 sub.ldr\n1 4 80 0 0 1 0 0 0 1 0 0 0 1 4242424.dat\n\
                0 FILE sub.ldr\n1 16 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n1 16 0 -24 0 1 0 0 0 1 0 0 0 1 4242424.dat\n";
    let model = model(text);
    let plan = Plan::of(&model);
    let csv = shopping_list(&model, &plan);
    let of_missing: Vec<&str> = csv.lines().filter(|line| line.contains("4242424.dat")).collect();
    let note = "missing from the parts library: not in the steps";
    assert_eq!(
        of_missing,
        [format!("2,4242424.dat,,1,Blue,4242424,7,{note}"), format!("1,4242424.dat,,4,Red,4242424,5,{note}")]
    );
    let xml = wanted_list(&model, &plan);
    assert!(xml.contains("<ITEMID>4242424</ITEMID>\n    <COLOR>7</COLOR>\n    <MINQTY>2</MINQTY>"), "{xml}");
    assert_eq!(xml.matches(note).count(), 2);
}

#[test]
fn lists_hold_every_part_and_say_what_they_do_not_know() {
    let model = model(
        "1 71 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n1 71 0 -24 0 1 0 0 0 1 0 0 0 1 3001.dat\n\
                       1 9999 0 -48 0 1 0 0 0 1 0 0 0 1 3003.dat\n",
    );
    let plan = Plan::of(&model);
    let csv = shopping_list(&model, &plan);
    let lines: Vec<&str> = csv.lines().collect();
    assert_eq!(lines[1], "2,3001.dat,Brick 2 x 4,71,Light Bluish Grey,3001,86,");
    assert!(lines[2].starts_with("1,3003.dat,Brick 2 x 2,9999,Unknown 9999,3003,,LDraw colour 9999"), "{}", lines[2]);
    let xml = wanted_list(&model, &plan);
    assert!(xml.starts_with("<INVENTORY>") && xml.trim_end().ends_with("</INVENTORY>"));
    assert_eq!((xml.matches("<ITEM>").count(), xml.matches("</ITEM>").count()), (2, 2));
    assert!(xml.contains("<ITEMID>3001</ITEMID>\n    <COLOR>86</COLOR>\n    <MINQTY>2</MINQTY>"), "{xml}");
    assert_eq!(xml.matches("<COLOR>").count(), 1, "an unknown colour is not guessed");
    assert!(xml.contains("<REMARKS>"));
}

#[test]
fn the_ending_chooses_the_form_and_a_stop_leaves_nothing() {
    struct Stop;
    impl mb_job::Progress for Stop {
        fn report(&self, _: &str, _: usize, _: usize) {}
        fn stop_requested(&self) -> bool {
            true
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let model = model(TOWER);
    let plan = Plan::of(&model);
    assert!(Form::of("a.docx".as_ref()).unwrap_err().to_string().contains("something.pdf"));
    let stopped = write_booklet(&model, &plan, &folder.path().join("a.pdf"), &Stop);
    assert!(matches!(stopped, Err(mb_job::Error::Stopped)));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}
