//! Whether every text of the page can be read: contrasts of WCAG 2.2, computed from the style's own colours.

use std::collections::BTreeMap;

const STYLE: &str = include_str!("page.css");
/// Colours of text, and what text stands on.
const TEXTS: [&str; 5] = ["text", "soft", "good", "bad", "doubt"];
const GROUNDS: [&str; 2] = ["back", "warn"];
/// The least contrast of text (level AA), and of what is no text.
const TEXT: f64 = 4.5;
const SHAPE: f64 = 3.0;

/// The variables of a `:root{...}`.
fn variables(block: &str) -> BTreeMap<&str, &str> {
    let inside = block.split(":root{").nth(1).and_then(|rest| rest.split('}').next()).expect("variables");
    inside.split(';').filter_map(|line| line.trim().strip_prefix("--")?.split_once(':')).collect()
}

/// Red, green and blue from 0 to 1.
fn channels(colour: &str) -> [f64; 3] {
    let digits = colour.strip_prefix('#').expect("a colour like #16181b or #fff");
    let wide: String = if digits.len() == 3 { digits.chars().flat_map(|c| [c, c]).collect() } else { digits.into() };
    assert_eq!(wide.len(), 6, "{colour}");
    [0, 2, 4].map(|at| f64::from(u8::from_str_radix(&wide[at..at + 2], 16).expect("hexadecimal digits")) / 255.0)
}

fn contrast(a: &str, b: &str) -> f64 {
    let linear = |x: f64| if x <= 0.04045 { x / 12.92 } else { ((x + 0.055) / 1.055).powf(2.4) };
    let luminance = |colour: &str| {
        let [r, g, b] = channels(colour).map(linear);
        0.2126 * r + 0.7152 * g + 0.0722 * b
    };
    let [a, b] = [luminance(a), luminance(b)];
    (a.max(b) + 0.05) / (a.min(b) + 0.05)
}

#[test]
fn contrasts_are_those_of_the_standard() {
    assert!((contrast("#000", "#ffffff") - 21.0).abs() < 1e-9);
    // The grey that just passes on white.
    assert!((contrast("#767676", "#fff") - 4.54).abs() < 0.01 && contrast("#777777", "#fff") < 4.5);
}

#[test]
fn every_text_can_be_read_in_light_and_dark() {
    let dark = STYLE.find("@media(prefers-color-scheme:dark)").expect("a dark scheme");
    let schemes = [("light", variables(&STYLE[..dark])), ("dark", variables(&STYLE[dark..]))];
    for (scheme, colours) in &schemes {
        for ground in GROUNDS {
            for text in TEXTS {
                let found = contrast(colours[text], colours[ground]);
                assert!(found >= TEXT, "{scheme}: --{text} on --{ground}: {found:.2}");
            }
            let found = contrast(colours["focus"], colours[ground]);
            assert!(found >= SHAPE, "{scheme}: --focus on --{ground}: {found:.2}");
        }
    }
    assert!(schemes[0].1.keys().eq(schemes[1].1.keys()), "both schemes name the same colours");
}

/// A colour that is written out would be the same in light and dark, and is not among those that are compared above.
#[test]
fn no_text_has_a_colour_of_its_own() {
    let mut seen = 0;
    for declaration in STYLE.split(['{', ';', '}']) {
        let Some((name, value)) = declaration.split_once(':') else { continue };
        if ["color", "fill"].contains(&name.trim()) {
            seen += 1;
            let variable = value.strip_prefix("var(--").and_then(|v| v.strip_suffix(')')).unwrap_or(value);
            assert!(TEXTS.contains(&variable) || (name == "fill" && variable == "back"), "{declaration}");
        }
    }
    assert!(seen > 6, "{seen} colours");
}
