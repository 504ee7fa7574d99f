// The pages' second language: German where the browser asks for it. English words are the keys, so what is missing stays readable.

/** @type {Record<string, string>} */
const GERMAN = {
  '3D photo': '3D-Foto',
  'All photos': 'Alle Fotos',
  'Back to the photo’s own view (0)': 'Zurück zur Sicht des Fotos (0)',
  'Best: every detail, a larger file': 'Beste: jede Einzelheit, größere Datei',
  'Blur of what is out of focus': 'Unschärfe außerhalb des Fokus',
  Cancel: 'Abbrechen',
  'Cancel {0}': '{0} abbrechen',
  'Choose photos': 'Fotos auswählen',
  'Click the picture where it should be sharp.': 'Ins Bild klicken, wo es scharf sein soll.',
  Close: 'Schließen',
  Delete: 'Löschen',
  'Delete {0}': '{0} löschen',
  Depth: 'Tiefe',
  'Depth map': 'Tiefenkarte',
  'Depth map of your own (a grey picture, near is bright; best a PNG of 16 bits), for one photo':
    'Eigene Tiefenkarte (graues Bild, Nahes ist hell; am besten ein PNG mit 16 Bit), für ein Foto',
  'Depth: a map of your own.': 'Tiefe: eine eigene Karte.',
  'Depth: as the photo brought it along.': 'Tiefe: wie das Foto sie mitbrachte.',
  'Depth: estimated by {0} in {1} s.': 'Tiefe: von {0} in {1} s geschätzt.',
  'the built-in network': 'dem eingebauten Netz',
  'The map has another shape than the photo and was stretched.': 'Die Karte hat eine andere Form als das Foto und wurde gestreckt.',
  'The photo’s own depth was left out: {0}': 'Die Tiefe im Foto blieb unbenutzt: {0}',
  'Dismiss {0}': '{0} ausblenden',
  Download: 'Laden',
  'Drawn by the server': 'Vom Server gezeichnet',
  'drawn by the server': 'vom Server gezeichnet',
  'Drop photos or a folder here, paste one, or': 'Fotos oder einen Ordner hierher ziehen, einfügen oder',
  Full: 'Vollbild',
  'Full screen': 'Vollbild',
  'JPEG, PNG or WebP, up to 32 MB. Place and camera data are removed.':
    'JPEG, PNG oder WebP, bis 32 MB. Orts- und Kameradaten werden entfernt.',
  'Good: for screens of any size': 'Gut: für jeden Bildschirm',
  'Link to this very view': 'Link zu genau dieser Sicht',
  'Link to this view': 'Link zu dieser Sicht',
  'Link to this view copied': 'Link zu dieser Sicht kopiert',
  Loading: 'Lädt',
  'Loading…': 'Lädt …',
  'Leaving out what is never seen': 'Nie Sichtbares weglassen',
  'Look around in a headset': 'In einer Brille umsehen',
  Motion: 'Wiegen',
  'Move by tilting the device': 'Durch Neigen bewegen',
  'Move gently by itself (space)': 'Bewegt sich von selbst (Leertaste)',
  'Move with a drag or the arrow keys, closer and farther with plus and minus, back with 0, motion on and off with the space bar.':
    'Ziehen oder Pfeiltasten bewegen, Plus und Minus gehen näher und weiter, 0 geht zurück, die Leertaste schaltet die Bewegung.',
  'No photo yet. The first one takes a few seconds.': 'Noch kein Foto. Das erste braucht ein paar Sekunden.',
  'No picture': 'Kein Bild',
  'Not made': 'Nicht erstellt',
  'One photo in, a 3D photo out': 'Ein Foto hinein, ein 3D-Foto heraus',
  Open: 'Öffnen',
  'Open {0}': '{0} öffnen',
  Options: 'Einstellungen',
  Packing: 'Packen',
  'Pasted photo': 'Eingefügtes Foto',
  Photo: 'Foto',
  Photos: 'Fotos',
  Planes: 'Ebenen',
  'Placing planes': 'Ebenen legen',
  'Progress of {0}': 'Fortschritt von {0}',
  'Quality of the next photos': 'Qualität der nächsten Fotos',
  Ready: 'Fertig',
  'Reading the photo': 'Foto lesen',
  'Estimating depth': 'Tiefe schätzen',
  'Cleaning the depth': 'Tiefe säubern',
  'Sharpening depth edges': 'Tiefenkanten schärfen',
  'Building layers': 'Schichten bauen',
  'Refining layers': 'Schichten verfeinern',
  'Checking the result': 'Ergebnis prüfen',
  Reset: 'Zurück',
  Sent: 'Gesendet',
  'Sending, {0} %': 'Wird gesendet, {0} %',
  Share: 'Teilen',
  Show: 'Anzeige',
  'Show more': 'Mehr zeigen',
  'Side by side for stereo viewers': 'Zwei Bilder für Stereobrillen',
  'Size of the file · time to draw a frame': 'Größe der Datei · Zeit für ein Bild',
  'A page for any browser (.html)': 'Eine Seite für jeden Browser (.html)',
  'A 3D model (.glb)': 'Ein 3D-Modell (.glb)',
  'Layers for Krita or GIMP (.ora)': 'Ebenen für Krita oder GIMP (.ora)',
  'Depth map (.png)': 'Tiefenkarte (.png)',
  'The 3D photo (.tmpi)': 'Das 3D-Foto (.tmpi)',
  'Take a photo': 'Foto aufnehmen',
  'The photo was deleted.': 'Das Foto wurde gelöscht.',
  'The photo': 'Das Foto',
  'The server draws this view. {0}': 'Der Server zeichnet diese Sicht. {0}',
  'The server is busy; trying again in {0} s': 'Der Server ist ausgelastet; neuer Versuch in {0} s',
  'This browser does not allow full screen': 'Dieser Browser erlaubt kein Vollbild',
  'This browser does not allow it': 'Dieser Browser erlaubt das nicht',
  'This page needs JavaScript.': 'Diese Seite braucht JavaScript.',
  'This view (.png)': 'Diese Sicht (.png)',
  '3D photos on a page': '3D-Fotos auf einer Seite',
  'What it shows': 'Was es zeigt',
  'To have one on yours': 'So kommt eines auf Ihre Seite',
  'Moves by itself, and as you drag it, tilt it or press the arrow keys.':
    'Bewegt sich von selbst, und wie Sie es ziehen, neigen oder mit Pfeiltasten schieben.',
  'As it came': 'Wie am Anfang',
  'Error: red is a pixel of parallax or more': 'Fehler: Rot ist ein Pixel Parallaxe oder mehr',
  'How far it moves': 'Wie weit es sich bewegt',
  'Picture of the list from here': 'Bild der Liste von hier',
  'Save with the photo': 'Beim Foto speichern',
  Saved: 'Gespeichert',
  Settings: 'Vorgaben',
  'Small: quick to load': 'Klein: schnell geladen',
  'Start from here': 'Von hier beginnen',
  Title: 'Titel',
  'What stays in place: far to near': 'Was stehen bleibt: fern bis nah',
  Tiles: 'Kacheln',
  'Try again': 'Nochmals versuchen',
  Undo: 'Rückgängig',
  Uploads: 'Hochgeladen',
  View: 'Sicht',
  'Waiting for its turn': 'Wartet, bis es an der Reihe ist',
  'Waiting for its turn, {0} before it': 'Wartet, {0} davor',
  'Waiting to be sent': 'Wartet aufs Senden',
  '{0} deleted': '{0} gelöscht',
  '{0} is ready.': '{0} ist fertig.',
  '{0} of {1}': '{0} von {1}',
  '{0} was deleted.': '{0} wurde gelöscht.',
};

const words = navigator.language?.toLowerCase().startsWith('de') ? GERMAN : {};

/**
 * `text` in the page's language, `{0}`, `{1}` … replaced by `values`.
 * @param {string} text
 * @param {(string | number)[]} values
 */
export function t(text, ...values) {
  return (words[text] ?? text).replace(/\{(\d)\}/g, (_, i) => String(values[i]));
}

/** Says the page itself in its language. */
export function translatePage() {
  if (words !== GERMAN) return;
  document.documentElement.lang = 'de';
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode;
    const value = node.nodeValue ?? '';
    const text = value.trim().replace(/\s+/g, ' ');
    if (words[text]) node.nodeValue = value.replace(/\S[\s\S]*\S|\S/, words[text]);
  }
  for (const name of ['title', 'aria-label', 'aria-roledescription']) {
    for (const element of document.querySelectorAll(`[${name}]`)) element.setAttribute(name, t(element.getAttribute(name) ?? ''));
  }
}
